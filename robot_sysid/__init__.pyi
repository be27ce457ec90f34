from robot_sysid.api import motors as motors
from robot_sysid.api.calls import identify as identify
from robot_sysid.api.calls import identify_from as identify_from
from robot_sysid.api.calls import information as information
from robot_sysid.api.calls import joint_torque_regressor as joint_torque_regressor
from robot_sysid.api.calls import payload as payload
from robot_sysid.api.calls import plan as plan
from robot_sysid.api.calls import read_log as read_log
from robot_sysid.errors import AmbiguousJointError as AmbiguousJointError
from robot_sysid.errors import ColumnsError as ColumnsError
from robot_sysid.errors import ExportError as ExportError
from robot_sysid.errors import HardwareAbort as HardwareAbort
from robot_sysid.errors import InputError as InputError
from robot_sysid.errors import ModelError as ModelError
from robot_sysid.errors import SimulationError as SimulationError
from robot_sysid.errors import SysidError as SysidError
from robot_sysid.parser import load_robot_model as load_robot_model

__version__: str
FUNCTIONS: dict[str, str]
ERRORS: tuple[str, ...]
