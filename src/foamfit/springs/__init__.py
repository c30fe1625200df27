"""The law of a spring, chains of springs, and the published parameter sets.

`law` holds the formulas, `spring` and `chain` what a user makes, `parameters` names and units,
`model` the vector of parameters that a fit varies. A newcomer may skip `kernels`, the same law with
its state (the branch) compiled, and `sensitivities`, its derivatives.
"""
