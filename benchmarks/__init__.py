"""Recorded measurements, and the code that writes them into the documentation.

`results/` has every table and plot of the documentation; `nafir bench --record` appends to `history/`.
"""
