"""Explicit steps: Taylor series in time, from switch of branch to switch of branch.

`series` are the recurrences of motion and derivatives, `taylor` goes from step to step.
A newcomer may skip all of it.
"""
