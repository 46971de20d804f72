"""Virtual stenting: a device, an `Anatomy` and a landing in, a `Deployment` with wires and wall gaps out.

Open ``deploy.py`` first; ``active_contour.py`` holds equations (1) to (7) of Zhong et al. 2016.
"""
