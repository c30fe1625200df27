"""Explicit steps: Taylor series in time between switches of branch. Newcomers may skip them.

`series`, `memory` and `tangents` hold the recurrences of motion and derivatives, `taylor` the loop
over steps, `samples` its output.
"""
