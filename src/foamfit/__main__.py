"""The command as `python -m foamfit`."""

from foamfit.cli import main

if __name__ == "__main__":  # not in the processes that the page starts
    main(prog_name="foamfit")
