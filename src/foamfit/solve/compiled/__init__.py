"""The compiled solver: one record for all functions, and the loop over time.

`run` is the record, `layout` says where its parts lie, and `loop` goes through time: `motion` and
`groups` have the equations of motion, `explicit` and `implicit` the steps, `events` the changes of
branch, `samples` the output. `along`, and `groups` in equilibrium, need no steps in time. Newcomers
may skip `internal` and `aggregate`.
"""
