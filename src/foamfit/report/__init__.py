"""What a person reads: the page, figures, comparisons, and the look ahead at a test.

`page` makes the report, `result_figures` and `plots` its figures, `plotted` the table of what these
show, `comparison` sets results beside published ones.
"""
