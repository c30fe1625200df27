"""Implicit steps for stiff scenes: collocation of order 9 in NumPy. Newcomers may skip them.

`collocation` solves one step, `control` sets its length, `steps` is the loop over steps, and
`vibration` estimates the vibrations that steps do not resolve.
"""
