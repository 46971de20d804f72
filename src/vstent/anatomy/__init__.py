"""From a scan or a surface to the parent artery: an `Image` or a `Surface` in, an `Anatomy` (sac, neck, artery) out.

The steps run in this order: ``segment``, ``repair``, ``openings``, ``trace``, ``trim``, ``restore``, ``morphology``.
Open ``trace.py`` first.
"""
