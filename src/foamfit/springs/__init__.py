"""The law of a spring, chains of springs, and the published parameter sets.

`law` has the formulas, `laws` the springs and their records, `chain` chains and drives,
`parameters` names and units, and `model` the flat vector of parameters of a fit. At first reading
skip `kernels` and `microscale_kernels` (the compiled laws with their state) and `sensitivities`
(derivatives of springs in equilibrium).
"""
