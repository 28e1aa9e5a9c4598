"""Which way did this person walk? A factor-graph smoothing backend for pedestrian dead reckoning.

A phone's sensor log, a floor plan and a few position fixes in; the most probable walked path out, with its covariance.

    walk = pdr.load("walk.zip")                      any supported recorder
    steps = pdr.detect_steps(walk)                   when, how far, which way
    fixes = pdr.frame_of(walk.fixes).place(walk.fixes)   in metres
    result = pdr.smooth(pdr.WalkGraph(steps, fixes)) the most probable walk

read       load  read_fixes  read_trajectory  FloorPlan  Building  PathNetwork  Walker  Frame
           frame_of
walk       detect_steps  magnetic_headings  dead_reckon  floors_of
estimate   WalkGraph  Prior  smooth  kalman_filter  kalman_smoother  verdict
live       Navigator  Journal  Event  Samples  Sensor  Scan  Pose  Mode  Status  events_of
extend     register  Measurement  FactorBlock  ROW  KEYFRAME  TABLE
look       plot  evaluate
simulate   Scenario  simulate
data       Recording  Signal  Sightings  Fixes  Headings  Steps  Trajectory  Calibration  Estimate  InputError
           Contradiction  Verdict  LONLAT

SI units and radians; x east, y north, or the floor plan's own frame; headings counter-clockwise from +x; arrays are
samples-first, ``(n, 2)``; times are seconds from the recording's start. What is not named here may change.
"""

import lazy_loader

__version__ = "0.2.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # names load when first used
