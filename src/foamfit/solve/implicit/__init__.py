"""Implicit steps for stiff scenes: collocation of order 9, from switch to switch.

`collocation` is one step, `control` its length, `recording` its samples; `steps` goes from step to
step, `vibration` estimates what steps do not resolve.
A newcomer may skip all of it.
"""
