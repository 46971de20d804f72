"""Page in the browser: a case folder or an uploaded scan in, an interactive plan and its report out.

Open ``server.py`` first. ``security`` guards the server and ``intake`` receives files. ``cases`` and ``choices`` hold
the user's choices. ``jobs`` and ``worker`` run the long stages, ``preview`` answers immediately while a device is
dragged, and ``live`` computes its flow meanwhile.
"""
