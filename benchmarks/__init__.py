"""Measured figures, and the pages that are made from them.

`results/` holds every table and plot of the documentation, `history/` what `nafir bench --record` adds to.
"""
