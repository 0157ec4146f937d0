"""What a user asks for: scene files, their keys and limits, messages.

schema: every key with type, limits, unit and meaning. load: from a TOML file to a `Scene`.
"""
