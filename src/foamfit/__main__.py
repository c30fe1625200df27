"""The command as `python -m foamfit`."""

from foamfit.cli import main

main(prog_name="foamfit")
