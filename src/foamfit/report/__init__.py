"""What a person reads: terminal, report, figures and comparisons.

The sentences stand in `templates`, `render` fills them in. `summary` makes the report; `plots`
draws the fit and `result_figures` what else the report shows, `figures` has what all pictures
share; `comparison` sets results beside published ones, `studies` is about several tests.
"""
