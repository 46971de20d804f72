"""Virtual stenting: turn a device, an `Anatomy` and a landing into a `Deployment` with wires and gaps to the wall.

Start reading in ``deploy.py``. ``active_contour.py`` holds equations (1) to (7) of Zhong et al. 2016.
"""
