"""The reproduction of Seifried, Moghadasi & Held (2015), doi:10.1016/j.piutam.2015.01.018.

`reproduction` has the cases and figures, and compares what comes out with the paper.
"""
