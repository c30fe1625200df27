"""Simulation: the response of a chain to a drive, by the simplest solver that suffices.

`simulation` has the public function and checks its result; `plan` chooses the solver. `run` is the
record that compiled functions take, `layout` says where its parts lie, and `loop` goes through
time: `motion` and `groups` have the equations of motion, `explicit` and `implicit` the steps,
`events` the changes of branch, `samples` the output. Newcomers may skip `internal`,
`aggregate`, `rates`, `precompile` and `cache`.
"""
