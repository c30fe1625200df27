"""Output for readers: terminal, report, figures and comparisons.

`render` fills the `templates` and makes tables of parameters. `summary` makes the report; `plots`
draws its figures, and `figures` contains their common layout and style. `folder` keeps results of
all kinds, `listing` the tables of fits; `comparison` compares results with published ones; `plan`
and `prediction` are the results of these studies.
"""
