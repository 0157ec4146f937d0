"""What a user asks for: scene files, their keys and limits, messages.

tables: every key with type, limits, unit and meaning, a file a table. schema: the whole `Scene`.
load: from a TOML file to a `Scene`.
"""
