"""Words of column titles in other languages, and abbreviations, as the English words of ``titles``.

``Gelenk 1 Winkel [Grad]`` becomes ``joint 1 position [deg]``. Only guesses use this: a title that
is recognised without it is never translated.
"""

from __future__ import annotations

import re
import unicodedata
from functools import cache

from robot_sysid.logs.joint_names import split_camel_case
from robot_sysid.logs.titles import by_token

# English word to the beginnings or parts of words that stand for it; accents are left out.
_PARTS = {
    "time": "zeitstempel zeit horodatage tiempo 时间 時間 时刻 時刻",
    "position": "gelenkwinkel winkel stellung posizione posicion posicao angulo angolo 位置 角度 "
    "关节角",
    "velocity": "winkelgeschwindigkeit geschwindigkeit drehzahl vitesse velocidad velocita "
    "velocite velocidade 角速度 速度 转速",
    "acceleration": "winkelbeschleunigung beschleunigung aceleracion accelerazione aceleracao "
    "角加速度 加速度",
    "torque": "drehmoment momento moment couple coppia 力矩 扭矩 转矩 トルク",
    "current": "strom courant corriente corrente 电流 電流",
    "command": "sollwert soll vorgabe consigne consigna riferimento referencia kommando 指令 目标 "
    "目標 期望 给定",
    "measured": "istwert gemessen mesure medid misurat 实际 实测 測定 反馈",
    "joint": "gelenk achse achs articulation articulaire articulacion articolare giunto 关节 関節 "
    "轴 軸",
    "motor": "moteur motore 电机 モータ",
    "temperature": "temperatur 温度",
    "voltage": "spannung tension 电压 電圧",
    "error": "abweichung fehler erreur errore 误差 誤差",
    "deg": "grad",
}
# English word to whole words that are too short to be looked for inside others.
_WORDS = {
    "time": "temps tempo zt sekunden segundos secondes secondi",
    "position": "ang angl lage phi theta",
    "velocity": "geschw vit omega w",
    "torque": "par mom drehm trq torq tor",
    "joint": "axe eje asse gel jt ach",
    "measured": "ist mes mis med",
    "command": "cons",
}
_BRACKET = r"[\[({][^\])}]*[\])}]"
_DEGREES = re.compile(r"\b(grados|gradi|grad|degres)\b")


@cache
def _english() -> tuple[re.Pattern[str], dict[str, str]]:
    """Return a pattern of brackets and of all foreign words, and the words' English ones."""
    stems = by_token(_PARTS)
    whole_words = by_token(_WORDS)
    # The longest first, as some begin like others.
    any_stem = "|".join(sorted(stems, key=len, reverse=True))
    any_word = "|".join(sorted(whole_words, key=len, reverse=True))
    # "ist" in front of a word of the title is the German "measured", as in Istposition.
    pattern = (
        rf"{_BRACKET}|{any_stem}|\bist(?=[a-z]{{3}})|(?<![a-z])(?:{any_word})(?![a-z])"
    )
    return re.compile(pattern), {**whole_words, **stems}


def translate(title: str) -> str:
    """Return a title with its foreign words in English, in lower case and without accents.

    Units in brackets stay as they are, but for degrees that are written out.
    """
    # A capital D behind a blank is the name of a joint, no mark of a command as in q_d.
    title = re.sub(r" D\b", " ", title)
    decomposed = unicodedata.normalize("NFKD", split_camel_case(title).lower())
    plain = "".join(mark for mark in decomposed if not unicodedata.combining(mark))
    pattern, meanings = _english()

    def replace_match(match: re.Match[str]) -> str:
        """Return the English word between blanks, or a bracket with the unit in it."""
        if match[0] in meanings:
            return f" {meanings[match[0]]} "
        return _DEGREES.sub("deg", match[0])

    return pattern.sub(replace_match, plain.replace("μ", "µ"))
