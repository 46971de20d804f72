"""The page in the browser: a case folder or a dropped scan in, an interactive plan and its report out.

Open ``server.py`` first. ``security`` guards the server, ``intake`` receives files, ``cases`` and ``choices`` hold what
the user has chosen, ``jobs`` and ``worker`` run the long stages, and ``live`` answers while a device is dragged.
"""
