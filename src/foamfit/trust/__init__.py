"""How certain the parameters are, and which of them the test determines.

`best_point` holds what was computed at the best point, `covariance` and `intervals` give numbers,
`checklist` asks what a good fit must pass, `conclude` gives each parameter its state. A newcomer
may skip `refit`, `profile`, `resample`, `evidence` and `residual_tests`. `law_error` tells what the
residual is made of, noise or an error of the law, and `ranges` what the latter leaves open.
"""
