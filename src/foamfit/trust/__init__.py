"""How certain the parameters are, and which of them the test determines.

`best_point` holds what was computed at the best point, `covariance` and `intervals` give numbers,
`checklist` asks what a good fit must pass, `conclude` gives each parameter its state; `residuals`
tells noise from an error of the law, `ranges` what the latter leaves open, and `sentences.toml` has
the words for all of it. A newcomer may skip `refit`, `profile`, `resample` and `evidence`.
"""
