"""From a chain, a drive and samples to a response, by the least solver that the scene needs.

`simulation` is the public call, which checks its answer; `plan` chooses the solver.
A newcomer may skip `explicit`, `many`, `rates` and `polynomial`, the compiled loops, with what they
share (`scene`), their first use (`precompile`, `cache`), and `implicit`, the steps of stiff scenes.
"""
