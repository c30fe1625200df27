"""How sure the parameters are, and which of them the test tells at all.

`covariance` and `intervals` give numbers, `checklist` asks what a good fit must pass, `conclude`
gives each parameter its state. A newcomer may skip `refit`, `evidence` and `residual_tests`.
"""
