"""A preference from choices: which of two drives of one policy a person likes better."""
