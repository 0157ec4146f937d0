"""The reproduction of Seifried, Moghadasi & Held (2015), doi:10.1016/j.piutam.2015.01.018.

`reproduction` is the table of cases, what comes out of them and the figures; `statements` compares
with the paper.
"""
