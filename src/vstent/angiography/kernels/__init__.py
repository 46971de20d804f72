"""Compiled loops of the contrast transport."""
