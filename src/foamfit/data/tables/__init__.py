"""Read a file as a table, and identify the columns of the channels."""
