"""Errors against truth, relations, map quality, and tables of them."""
