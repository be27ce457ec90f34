from robot_sysid.api import identify as identify
from robot_sysid.api import identify_arm as identify_arm
from robot_sysid.api import identify_from as identify_from
from robot_sysid.api import information as information
from robot_sysid.api import load_robot_model as load_robot_model
from robot_sysid.api import payload as payload
from robot_sysid.api import plan as plan
from robot_sysid.api import read_log as read_log

__version__: str
FACE: tuple[str, ...]
