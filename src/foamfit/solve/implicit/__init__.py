"""Implicit steps for stiff scenes, in plain NumPy: collocation of order 9, from switch to switch.

`collocation` is one step, `control` its length; `steps` goes from step to step, `vibration`
estimates what steps do not resolve.
A newcomer may skip all of it.
"""
