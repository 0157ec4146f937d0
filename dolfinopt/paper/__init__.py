"""Seifried, Moghadasi & Held (2015): its figures, results and checks, and the page."""
