"""Bare arrays in, bare arrays out, compiled where it pays."""
