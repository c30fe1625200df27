"""The law of a spring, chains of springs, and the published parameter sets.

`law` holds the formulas, `spring` and `chain` what a user makes, `model` the names of parameters.
A newcomer may skip `kernels`: the same law, compiled.
"""
