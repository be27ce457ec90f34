from robot_sysid.api import identify as identify
from robot_sysid.api import identify_arm as identify_arm
from robot_sysid.api import identify_from as identify_from
from robot_sysid.api import information as information
from robot_sysid.api import load_robot_model as load_robot_model
from robot_sysid.api import motors as motors
from robot_sysid.api import payload as payload
from robot_sysid.api import plan as plan
from robot_sysid.api import read_log as read_log
from robot_sysid.api import regressor as regressor
from robot_sysid.errors import AmbiguousJointError as AmbiguousJointError
from robot_sysid.errors import ColumnsError as ColumnsError
from robot_sysid.errors import ExportError as ExportError
from robot_sysid.errors import HardwareAbort as HardwareAbort
from robot_sysid.errors import InputError as InputError
from robot_sysid.errors import ModelError as ModelError
from robot_sysid.errors import SimulationError as SimulationError
from robot_sysid.errors import SysidError as SysidError

__version__: str
FACE: tuple[str, ...]
ERRORS: tuple[str, ...]
