"""Simulation: the response of a chain to a drive, by the simplest solver that suffices.

`simulation` has the public function and checks its result; `plan` chooses the solver.
Newcomers may skip the compiled loops (`explicit`, `many`, `rates`, `polynomial`), their shared
types (`scene`) and compilation (`precompile`, `cache`), and the solver of stiff scenes, `implicit`.
"""
