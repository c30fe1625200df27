"""What a person reads: terminal, report, figures, comparisons, and the look ahead at a test.

The sentences stand in `templates`, `render` fills them in. `page` makes the report, `plots` and
`result_figures` its figures; `comparison` sets results beside published ones.
"""
