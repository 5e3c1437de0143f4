"""lidarpose: where a LiDAR is, how sure that is, and what it sees in metric 3D.

Importing the package is cheap on purpose; the work lives in its sub-packages:

* ``lidarpose.workflows``: whole jobs as pure functions, from a session to a calibration
* ``lidarpose.model``: the nouns that they exchange (cameras, scans, sessions, observations, calibrations)
* ``lidarpose.storage``: files in and out
"""

__version__ = "0.1.0"
