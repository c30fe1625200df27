"""Laws for the stepper, one in a file."""
