"""The law of a spring, chains of springs, and the published parameter sets.

`law` holds the formulas, `spring` and `chain` what a user makes, `parameters` names and units,
`model` the vector of parameters that a fit varies, `microscale` micro-springs with any other laws
of snapping. A newcomer may skip `kernels` and `microscale_kernels`, the same laws with their state
(the branch, and what has snapped) compiled, and `sensitivities`, derivatives of the former.
"""
