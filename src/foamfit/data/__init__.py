"""From the files of a test to a measurement in SI, ready to be fitted.

`csv_file` and `toml_file` read, `prepare` finds contact and cycles, `noise` estimates, `energy`
audits what striker, force and motion say of each other. A newcomer may skip `units`.
"""
