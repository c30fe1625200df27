"""From the files of a test to a measurement in SI, ready to be fitted.

`csv_file.read_test` tells the whole way. `tables` finds the numbers of a file, their channels and
units, `toml_file` the specimen and the striker. `frames` puts a motion with a clock of its own on
that of the force. `prepare.condition` turns the samples into one loading and unloading: `outliers`
mends single samples and a gauge that stood still, `cycles` and `contact` find the part that counts,
`zeros` what the channels show without load. `noise` estimates, `motion` follows a noisy one,
`energy` audits what striker, force and motion say of each other, `describe` prints a test.
"""
