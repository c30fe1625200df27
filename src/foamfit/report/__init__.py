"""What a person reads: the page, figures, comparisons, and the look ahead at a test.

`page` makes the report, `plots` its figures, `plotted` the table of what these show, `comparison`
sets results beside published ones.
A newcomer may skip `explore`, which draws for the sliders of a notebook.
"""
