"""The law of a spring, chains of springs, and the published parameter sets.

`laws` has the springs and their records, `chain` chains and drives, `parameters` names and units,
and `model` the flat vector of parameters of a fit. At first reading skip `compiled`, the compiled
laws and the contract between them and the solver.
"""
