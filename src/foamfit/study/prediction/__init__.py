"""What a prediction is made of: what a result says, draws of a new specimen, what is found.

A newcomer reads `foamfit.study.predict` first.
"""
