"""From a file to a table: its text, the numbers in it, and which column is which channel."""
