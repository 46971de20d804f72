"""From a scan or a surface to the parent artery: from an `Image` or a `Surface` to an `Anatomy` (sac, neck, artery).

The steps run in this order: ``segment``, ``repair``, ``openings``, ``trace``, ``trim``, ``restore``, ``morphology``.
Read ``trace.py`` first.
"""
