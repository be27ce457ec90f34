"""The meaning of a log's column titles: quantity, joint and unit.

A title is cut into tokens: ``j0_pos`` gives j, 0, pos; ``jointVelocity[3] (deg/s)`` gives joint,
velocity, 3 and the unit deg/s; ``q1`` gives q, 1. Every token has to be in the vocabulary: a title
with a foreign token (``joint1_position_std``, ``q1_filtered``) does not stand for the plain
quantity.

A title says what it stands for at two confidences: ``joint_quantity`` is certain, and
``likely_quantity`` goes by single words beside others, by words of other languages, and where no
word says it by the unit. ``matching`` finds the columns of all joints at either.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from robot_sysid.logs.joint_names import split_camel_case
from robot_sysid.records.messages import visible


def token_set(text: str) -> frozenset[str]:
    """Return the tokens of a text, which are separated by blanks."""
    return frozenset(text.split())


def by_token(vocabulary: Mapping[Any, str]) -> dict[str, Any]:
    """Return token to meaning, from a table of meaning to tokens that are separated by blanks."""
    meanings = {}
    for meaning, tokens in vocabulary.items():
        meanings.update(dict.fromkeys(tokens.split(), meaning))
    return meanings


QUANTITY_OF_TOKEN = by_token(
    {
        "time": "time t timestamp timestamps stamp stamps clock",
        "position": "q pos position positions angle angles qpos jpos",
        "velocity": "qd dq qdot dqdt vel velocity velocities speed speeds qvel jvel",
        "acceleration": "qdd ddq qddot acc accel acceleration accelerations qacc jacc",
        "torque": "tau taus torque torques effort efforts eff trq tq force forces moment moments",
    }
)
"""Token of a title to the quantity that it stands for."""

# Tokens that mark a command or a reference.
_COMMANDED = token_set(
    "cmd command commanded commands des desired ref reference target setpoint sp goal planned "
    "plan ff feedforward d action actions soll"
)
# Tokens of commands that do not stand for commanded positions.
_FEED_FORWARD = token_set("ff feedforward")
# Tokens that mark a torque as computed by a model.
_COMPUTED = token_set(
    "model computed calculated calc predicted rigid gravity grav friction ext external simulated "
    "sim"
)
# Tokens that may be in a title without changing its quantity.
_NEUTRAL = token_set(
    "j jnt joint joints axis ax a m motor motors dof arm robot field state states js jointstate "
    "jointstates header meas measured measurement act actual fb feedback msr present current "
    "sensor data values value currents as observation observations obs"
)
# Tokens of positions where none says the quantity: what LeRobot calls the state it observed.
_STATE = token_set("observation state")
# Tokens of a motor's current; "current" may mean "present" as well.
_CURRENT = token_set("current currents")
# Tokens of the time from row to row.
_STEPS = token_set(
    "dt step steps period interval cycle takt zyklus zykluszeit 周期 間隔"
)
# Tokens of an encoder's counts, which are positions.
_COUNTS = token_set("ticks counts encoder enc")
# Sequences of tokens to the single token that they stand for; Unitree calls its torque tauEst.
_JOINED = {
    " tau est ": " tau ",
    " q dot ": " qd ",
    " q ddot ": " qdd ",
    " dot q ": " qd ",
    " ddot q ": " qdd ",
}

# Words of other languages, without accents, to the English ones that they stand for. They make a
# title likely, never certain. German, Chinese and Japanese run them together.
_TRANSLATIONS = by_token(
    {
        "time": "zeit zeitstempel uhrzeit tiempo temps tempo 时间 时间戳 时刻 時間 時刻",
        "position": "winkel drehwinkel lage stellung posicion angulo posizione angolo posicao "
        "角 角度 转角 轉角 角位置 位置",
        "velocity": "geschwindigkeit winkelgeschwindigkeit drehzahl velocidad velocita velocidade "
        "vitesse 速度 角速度 转速 轉速",
        "acceleration": "beschleunigung winkelbeschleunigung aceleracion accelerazione aceleracao "
        "加速度 角加速度",
        "torque": "load drehmoment momenten par esfuerzo momento couple coppia "
        "力矩 扭矩 转矩 轉矩 扭力 トルク",
        "current": "strom corriente courant corrente 电流 電流",
        "target": "sollwert sollwerte consigna deseada deseado comandada comandado consigne cible "
        "riferimento desiderata desiderato comandata referencia 目标 目標 指令 期望 给定 设定 参考 "
        "命令 规划",
        "ff": "vorsteuer vorsteuerung 前馈",
        "measured": "istwert istwerte gemessen gemessene gemessener gemessenes real reel reelle "
        "mesure mesuree medida medido misurata misurato 实际 实测 测量 反馈 当前 當前 實際 "
        "実測 実際 計測 測定 現在",
        "model": "modell berechnet berechnetes modelo modele modello calculado teorico theorique "
        "理论 模型 计算 理論 計算",
        "external": "extern externes externo esterno externe externa esterna 外 外部",
        "gravity": "schwerkraft gewichts gravitations gravedad gravite gravita 重力",
        "friction": "reib reibung reibungs friccion frottement attrito 摩擦 摩擦力",
        "error": "fehler abweichung differenz schlepp schleppfehler schleppabstand "
        "positionsfehler erreur errore ecart desviacion 误差 偏差 誤差",
        "temperature": "temperatur temperatura 温度 溫度",
        "voltage": "spannung voltaje tensione 电压 電圧 電壓",
        "joint": "gelenk gelenks achs achse achsen antrieb antriebs eje axe giunto asse junta "
        "articulacion articulation 关节 關節 関節 轴 軸 电机 電機 马达 馬達 モータ モーター "
        "机器人 机械臂 传感器 编码器 输出 值",
    }
)
# Words of the vocabulary that are German, too.
_GERMAN = {"soll", "ist", "motor", "moment", "position"}


def _any_word(words: Iterable[str]) -> re.Pattern[str]:
    """Return a pattern of any of the words, the longest that fits."""
    longest_first = sorted(words, key=len, reverse=True)
    return re.compile("|".join(longest_first))


_TRANSLATED = _any_word({*_TRANSLATIONS, *_GERMAN})
# Tokens of what is no position, velocity, torque or current itself, whatever stands beside.
_OTHER = token_set(
    "error errors err std stddev stdev variance cov residual residuals diff difference noise "
    "temperature temperatures temp voltage voltages status enable enabled"
)

DEGREE = math.pi / 180
TIME_UNITS = ("s", "ms", "us", "ns")
"""Units of time that a user may declare, the longest first."""
_TIMES = by_token(
    {
        1.0: "s sec secs second seconds",
        1e-3: "ms msec millis",
        1e-6: "us usec µs micros",
        1e-9: "ns nsec nanos",
    }
)
_POSITIONS = by_token(
    {
        1.0: "rad rads radians m",
        DEGREE: "deg degree degrees °",
        DEGREE / 100: "cdeg centideg centidegrees",
        2 * math.pi: "rev revs turn turns",
        1e-3: "mm mrad",
    }
)
UNITS = {
    "time": _TIMES,
    "joint_time": _TIMES,
    "position": _POSITIONS,
    "command": _POSITIONS,
    "velocity": by_token(
        {
            1.0: "rads radsec rad rads1 ms m",
            DEGREE: "degs deg dps degsec °s",
            DEGREE / 100: "cdegs cdeg",
            2 * math.pi: "revs rev",
            math.pi / 30: "rpm",
            1e-3: "mms mm mrads mrad",
        }
    ),
    "torque": by_token({1.0: "nm n", 1e-3: "mnm", 1e-2: "ncm", 1e3: "knm"}),
    "current": by_token({1.0: "a amp amps ampere amperes", 1e-3: "ma"}),
}
"""Quantity to unit, in letters and digits alone ("degs" for deg/s), to its value in SI units."""
# Tokens of a title that are a unit, or a part of one.
_UNIT_TOKENS = token_set(
    "s sec secs second seconds ms msec millis us usec µs micros ns nsec nanos rad rads radians deg "
    "degs degree degrees ° cdeg centideg centidegrees mrad dps rpm mm nm mnm ncm knm ma s2"
)
# Units that no other quantity has, to the quantity.
_QUANTITY_OF_UNIT = by_token(
    {
        "position": "rad rads radians mrad deg degree degrees °",
        "velocity": "radsec rads1 degs dps degsec °s mrads rpm",
        "torque": "nm mnm ncm knm",
        "current": "a amp amps ampere amperes ma",
    }
)
# Units in brackets as other languages write them.
_UNIT_WORDS = by_token(
    {
        "deg": "grad grados grado gradi degres degre graus 度",
        "rad": "radianes radianti radiant 弧度 ラジアン",
        "ms": "毫秒 ミリ秒 millisekunden milisegundos",
        "us": "微秒",
        "s": "秒 sek sekunden segundos secondes secondi",
        "ma": "毫安",
        "a": "安 安培",
        "nm": "牛米 牛·米 牛顿米",
        "percent": "%",
        "permille": "‰",
    }
)
_UNIT_WORD = _any_word(_UNIT_WORDS)
# Text in round, square or curly brackets.
_BRACKETS = re.compile(r"[\[({]([^\])}]*)[\])}]")

# A joint in brackets: its number, such as 3, A3 or axis_3.
_INDEX = re.compile(r"[^\W\d_]*[ _]?\d+")
# Units with a capital letter, which is not the first one of a word.
_UNIT_OF_CAPITALS = re.compile(r"(?<![a-zA-Z])([mk]?N[.·⋅]?m|mA)(?![a-zA-Z])")
# Brackets of East Asian fonts to those of others.
_NARROW = str.maketrans("（）［］｛｝", "()[]{}")
# A title with any other token does not stand for a quantity.
_VOCABULARY = {*QUANTITY_OF_TOKEN, *_NEUTRAL, *_COMMANDED}


@dataclass(frozen=True)
class Title:
    """A column title, cut into tokens, numbers and unit.

    Attributes:
        text: the title as the file has it.
        tokens: the title's words in lower case, without units and numbers, and without the joint's
            name where that is one of the model's.
        numbers: the whole numbers in the title, without those of such a name.
        unit: in lower case, letters and digits alone ("deg/s" is "degs"); "" for none.
        joint: name of the joint: the model's where the title has that as it is written, else the
            words beside the quantity; "" for none.
    """

    text: str
    tokens: tuple[str, ...]
    numbers: tuple[int, ...]
    unit: str
    joint: str

    @property
    def quantity(self) -> str | None:
        """The one quantity that it names; None for none, for several, or with a foreign token."""
        return None if {*self.tokens} - _VOCABULARY else self.quantity_beside_name

    @property
    def joint_quantity(self) -> str | None:
        """Which quantity of one joint it stands for, or None.

        It is "joint_time" for a joint's own time stamp.
        """
        if self.quantity != "time":
            return self.quantity
        # A bare "t" beside a joint could as well be its torque or temperature.
        is_stamp = {*self.tokens} & {"time", "stamp", "timestamp"}
        return "joint_time" if is_stamp else None

    @property
    def is_commanded(self) -> bool:
        """Whether a token marks it as a command or a reference, not a measurement."""
        return bool(_COMMANDED & {*self.tokens})

    @property
    def torque_kind(self) -> str | None:
        """Whether a torque is "commanded", "computed" or "measured", by its tokens; None for no
        torque.
        """
        tokens = {*self.tokens}
        if "torque" not in map(QUANTITY_OF_TOKEN.get, tokens):
            return None
        if self.is_commanded:
            return "commanded"
        return "computed" if tokens & _COMPUTED else "measured"

    @property
    def quantity_beside_name(self) -> str | None:
        """The one quantity that it names beside any other words; None for none, or for several.

        It is "command" for a commanded position, such as ``q_des[0]``, ``action 1``, and "current"
        for a motor's current.
        """
        tokens = {*self.tokens}
        named = {QUANTITY_OF_TOKEN[t] for t in tokens if t in QUANTITY_OF_TOKEN}
        # This may mean "present" as well.
        has_current = _CURRENT & tokens
        if self.is_commanded:
            marks = tokens & (_COMMANDED - _FEED_FORWARD)
            # A bare d is too short to stand for a command without a position beside it.
            is_marked = marks and (marks != {"d"} or named)
            is_position = named <= {"position"} and not has_current
            return "command" if is_marked and is_position else None
        if has_current and not named:
            return "current"
        if tokens >= _STATE and not named:
            return "position"
        return min(named) if len(named) == 1 else None

    @property
    def is_time_step(self) -> bool:
        """Whether a word says that it is the time from row to row."""
        return not _STEPS.isdisjoint(self.tokens)

    @property
    def translated(self) -> Title:
        """The title with English words for those of other languages."""
        tokens: list[str] = []
        for token in self.tokens:
            words = _TRANSLATED.findall(token)
            # A word of which a part is foreign is none.
            parts = words if "".join(words) == token else [token]
            tokens += [_TRANSLATIONS.get(part, part) for part in parts]
        return replace(self, tokens=tuple(tokens))

    @property
    def likely_quantity(self) -> str | None:
        """What it names beside other words: a quantity, how a torque was not measured, or "other"
        for something else, such as the error of a position.

        Where no word says it, a unit does that no other quantity has; a unit of currents outranks
        the word of a torque.
        """
        title = self.translated
        if not _OTHER.isdisjoint(title.tokens):
            return "other"
        if not _COUNTS.isdisjoint(title.tokens):
            return "position"
        kind = title.torque_kind
        if kind in ("commanded", "computed"):
            return kind
        named = title.quantity_beside_name
        measured = _QUANTITY_OF_UNIT.get(self.unit)
        if measured == "current" and named in (None, "torque"):
            return measured
        # A word of a command, or of several quantities, says what the unit alone would not.
        is_silent = named is None and not title.is_commanded
        return measured if is_silent else named


def read_title(text: str, joint_names: Sequence[str] = ()) -> Title:
    """Return a title cut into tokens, numbers and unit.

    A title begins or ends with a joint's name exactly as written, so that ``#3`` and ``arm-1`` are
    matched and ``arm_1`` is told from ``arm-1``. The longest name whose remainder is a quantity is
    left out.
    """
    stripped = text.strip().translate(_NARROW)
    for name in sorted(joint_names, key=len, reverse=True):
        form = re.escape(visible(name))
        match = re.fullmatch(rf"(?s){form}([\W_].*)|(.*[\W_]){form}", stripped)
        if match:
            title = replace(read_title(match[1] or match[2]), text=text, joint=name)
            if title.joint_quantity and not title.numbers:
                return title
    unit = ""
    unitless = stripped.lstrip("%#")
    for content in _BRACKETS.findall(unitless):
        # What ends in a number is a joint's.
        index = _INDEX.fullmatch(content.strip())
        if not index:
            plain = _without_accents(content.lower().replace("μ", "µ"))
            english = _UNIT_WORD.sub(lambda word: _UNIT_WORDS[word[0]], plain)
            unit = re.sub(r"[^a-z0-9°µ]", "", english)
        unitless = _BRACKETS.sub(f" {index[0]} " if index else " ", unitless, count=1)
    numbers = []
    phrase = " "
    trailing_unit = ""
    for piece in _pieces(unitless):
        if piece.isdigit():
            numbers.append(int(piece))
        elif piece in _UNIT_TOKENS:
            trailing_unit += piece
        else:
            phrase += f"{piece} "
    for separate, joined in _JOINED.items():
        phrase = phrase.replace(separate, joined)
    joint = _words_beside_quantity(unitless)
    tokens = tuple(phrase.split())
    return Title(text, tokens, tuple(numbers), unit or trailing_unit, joint)


def _pieces(text: str) -> list[str]:
    """Return the runs of letters, in lower case, and of digits; camelCase is two runs, Nm one."""
    with_units = _UNIT_OF_CAPITALS.sub(lambda m: re.sub(r"\W", "", m[0]).lower(), text)
    plain = _without_accents(split_camel_case(with_units).lower())
    return re.findall(r"(?:[^\W\d_]|°)+|\d+", plain)


def _without_accents(text: str) -> str:
    """Return a text in small letters without the accents of Latin ones."""
    apart = unicodedata.normalize("NFD", text)
    plain = re.sub(r"(?<=[a-z])[\u0300-\u036f]+", "", apart)
    return unicodedata.normalize("NFC", plain)


def _words_beside_quantity(unitless: str) -> str:
    """Return a title without its quantity and unit; "" for a bare number, which is counted.

    ``unitless``: the title without a unit in brackets.
    """
    not_names = {*QUANTITY_OF_TOKEN, *_UNIT_TOKENS, *_CURRENT, *_COMMANDED}
    pieces = re.split(r"([^\W\d_]+)", split_camel_case(unitless))
    kept = [piece for piece in pieces if piece.lower() not in not_names]
    name = "".join(kept).strip(" ._/:-")
    return name if re.search(r"[^\W\d_]", name) else ""
