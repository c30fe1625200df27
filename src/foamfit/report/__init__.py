"""What a person reads: the page, figures, comparisons, and the look ahead at a test.

`page` makes the report, `plots` its figures, `comparison` sets results beside published ones.
"""
