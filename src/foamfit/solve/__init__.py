"""From a chain, a drive and samples to a response, by the least solver that the scene needs.

`simulation` is the public call, which checks its answer; `plan` chooses the solver.
A newcomer may skip `explicit`, `implicit`, `many` and `polynomial`, the compiled loops, with what
they share (`scene`), and `precompile` and `cache`, their first use.
"""
