"""Simulation: the response of a chain to a drive, by the simplest solver that suffices.

`simulation` has the public function and checks its result, `plan` chooses the solver, `compiled`
has the solvers. `cache` and `precompile` are about compilation at first use.
"""
