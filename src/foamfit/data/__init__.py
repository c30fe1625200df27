"""Read the files of a test and prepare a measurement in SI units, ready to be fitted.

Start with `csv_file.read_test`. `tables` finds the columns of a file, their channels and units;
`toml_file` reads the specimen and the striker. `frames` aligns a motion that has its own clock with
the force. `prepare.condition` reduces the samples to one loading and unloading: `outliers` repairs
single samples and a stuck gauge, `cycles` and `contact` select the samples in contact, `zeros`
finds the zero of each channel. `noise` estimates the noise, `motion` smooths a noisy displacement,
`energy` and `calibration` check striker, force and motion against each other. `rig` reads what
tests a rig can make.
"""
