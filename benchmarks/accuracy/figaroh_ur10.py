"""FIGAROH's own simulated UR10, whose truth is known: robot-sysid against FIGAROH's least squares.

    git clone https://github.com/thanhndv212/figaroh-examples    # anywhere; nothing is fetched here
    pip install -e . figaroh
    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.figaroh_ur10 figaroh-examples/examples/ur10

A minute. Both get positions and torques of its motion ``train`` with the noise that its protocol
states, from the same model, and make the derivatives of positions their own way. Judged are the
rigid-body torques along its motion ``validation``, at exact positions and derivatives, against its
torques without noise: those of robot-sysid's written file by ``mj_inverse``, those of FIGAROH's 36
base parameters by its regressor. FIGAROH's side needs its package, and is left out without it.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np

from robot_sysid.api.calls import identify
from robot_sysid.model.compilation import compile_model

NOISE = {"none": (0.0, 0.0), "low": (0.01, 1e-5), "high": (0.05, 1e-4)}
"""Its levels: torque noise, relative to each joint's root mean square, and of positions [rad]."""
SEEDS = (101, 102, 103, 104, 105)
JOINTS = 6
RATE = 100.0


def split(folder: Path, name: str) -> tuple:
    """Return positions, velocities, accelerations and torques (N, 6) of one of its motions."""
    table = np.genfromtxt(folder / "data/truth" / f"{name}.csv", delimiter=",")[1:]
    return tuple(np.split(table[:, 1:], 4, axis=1))


def measure(motion: tuple, level: str, seed: int) -> tuple:
    """Return positions and torques with noise, drawn as its protocol says."""
    q, _, _, tau = motion
    torque_share, position_noise = NOISE[level]
    random = np.random.RandomState(seed)
    torque_noise = random.standard_normal(tau.shape) * np.sqrt(np.mean(tau**2, axis=0))
    q_noise = random.standard_normal(q.shape)
    return q + position_noise * q_noise, tau + torque_share * torque_noise


def file_torque(path: Path, motion: tuple):
    """Return the torque (N, 6) of a model file by MuJoCo's inverse dynamics."""
    model = compile_model(path).mj_model
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(model)
    torques = []
    for q, qd, qdd in zip(*motion[:3]):
        data.qpos[:] = q
        data.qvel[:] = qd
        data.qacc[:] = qdd
        mujoco.mj_inverse(model, data)
        torques.append(data.qfrc_inverse.copy())
    return np.array(torques) + model.dof_frictionloss * np.sign(motion[1])


def ours(model: Path, q, tau, validation: tuple):
    """Return the torque of the file that robot-sysid writes, with its defaults."""
    log = {"time": np.arange(len(q)) / RATE, "q": q, "tau": tau}
    # Torques without friction are doubted: a measured arm has some.
    result = identify(model, log, accept=["computed"])
    with tempfile.TemporaryDirectory() as folder:
        paths = result.save(folder)
        written = [path for path in paths if path.suffix in (".xml", ".urdf")]
        return file_torque(written[0], validation)


class Figaroh:
    """FIGAROH's base parameters by least squares, through its own functions.

    Args:
        model: its model, as it came.
        motion: the exact motion that selects the base parameters.
    """

    settings = {
        "has_friction": False,
        "has_actuator_inertia": False,
        "has_joint_offset": False,
        "is_joint_torques": True,
        "is_external_wrench": False,
        "force_torque": None,
        "act_idxv": list(range(JOINTS)),
    }

    def __init__(self, model: Path, motion: tuple) -> None:
        import pinocchio
        from figaroh.identification.parameter import get_standard_parameters
        from figaroh.tools.qrdecomposition import get_baseParams
        from figaroh.tools.regressor import build_regressor_reduced, get_index_eliminate

        self.model = pinocchio.buildModelFromUrdf(str(model))
        self.data = self.model.createData()
        standard = get_standard_parameters(self.model, self.settings)
        regressor = self.whole_regressor(*motion[:3])
        self.zero_columns, names = get_index_eliminate(regressor, standard, 1e-6)
        reduced = build_regressor_reduced(regressor, self.zero_columns)
        self.base = list(get_baseParams(reduced, names, standard)[2])

    def whole_regressor(self, q, qd, qdd):
        """Return its regressor of all parameters, joint by joint."""
        from figaroh.tools.regressor import build_regressor_basic

        return build_regressor_basic(self, q, qd, qdd, self.settings)

    def regressor(self, q, qd, qdd):
        """Return its regressor of the base parameters."""
        from figaroh.tools.regressor import build_regressor_reduced

        whole = self.whole_regressor(q, qd, qdd)
        return build_regressor_reduced(whole, self.zero_columns)[:, self.base]

    def torque(self, motion: tuple, tau, validation: tuple):
        """Return the torque (N, 6) of base parameters fitted to a motion (q, qd, qdd)."""
        target = tau[: len(motion[0])].T.ravel()
        values = np.linalg.lstsq(self.regressor(*motion), target, rcond=None)[0]
        return (self.regressor(*validation[:3]) @ values).reshape(JOINTS, -1).T

    def derivatives(self, q) -> tuple:
        """Return positions, velocities and accelerations as it differentiates positions."""
        from figaroh.identification import identification_tools

        differentiate = (
            identification_tools.calculate_first_second_order_differentiation
        )
        return differentiate(self.model, q, {"ts": 1.0 / RATE})


def errors(folder: Path, level: str, figaroh: Figaroh | None) -> dict:
    """Return the mean error of each side over the seeds, relative to the torque."""
    train = split(folder, "train")
    validation = split(folder, "validation")
    model = folder / "urdf/ur10_robot.urdf"
    shares = []
    for seed in SEEDS[: 1 if level == "none" else None]:
        q, tau = measure(train, level, seed)
        sides = {"robot-sysid": ours(model, q, tau, validation)}
        if figaroh is not None:
            own = figaroh.derivatives(q)
            exact = (q, *train[1:3])
            sides["FIGAROH"] = figaroh.torque(own, tau, validation)
            sides["FIGAROH, given exact derivatives"] = figaroh.torque(
                exact, tau, validation
            )
        size = np.linalg.norm(validation[3])
        shares.append(
            {
                name: np.linalg.norm(torque - validation[3]) / size
                for name, torque in sides.items()
            }
        )
    return {name: np.mean([share[name] for share in shares]) for name in shares[0]}


def main(folder: str) -> None:
    """Print the errors of both sides at each level of noise."""
    root = Path(folder)
    validation = split(root, "validation")
    nominal = file_torque(root / "urdf/ur10_robot.urdf", validation) - validation[3]
    share = np.linalg.norm(nominal) / np.linalg.norm(validation[3])
    print(f"its model, as it came: {100 * share:.3g} %")
    try:
        figaroh = Figaroh(root / "urdf/ur10_robot.urdf", split(root, "train"))
    except ImportError:
        figaroh = None
    for level in NOISE:
        for name, error in errors(root, level, figaroh).items():
            print(f"noise {level}: {name} {100 * error:.2g} %")


if __name__ == "__main__":
    main(*sys.argv[1:])
