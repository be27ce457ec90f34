"""The face for Python programs: what the commands do, with arrays in and results out.

Nothing is printed, and no file is written unless a result is asked to ``save``.
"""

from __future__ import annotations

from robot_sysid.api.calls import identify as identify
from robot_sysid.api.calls import identify_arm as identify_arm
from robot_sysid.api.calls import identify_from as identify_from
from robot_sysid.api.calls import information as information
from robot_sysid.api.calls import payload as payload
from robot_sysid.api.calls import plan as plan
from robot_sysid.api.calls import read_log as read_log
from robot_sysid.api.equations import regressor as regressor
from robot_sysid.parser import load_robot_model as load_robot_model
