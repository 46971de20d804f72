"""Virtual angiogram: flow in, films out; open ``film.py`` first."""
