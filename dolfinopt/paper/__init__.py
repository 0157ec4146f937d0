"""The reproduction of Seifried, Moghadasi & Held (2015), doi:10.1016/j.piutam.2015.01.018.

`reproduction` plans and measures, `checks` compares with the paper's statements, `page` writes.
"""
