# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the name of a topic or a column says: its role in a loop, a time, its unit.

Words are those of English, German, French, Spanish, Italian, Portuguese and Dutch, without
accents.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping

SETPOINT, COMMAND, MEASUREMENT = "set-point", "command", "measurement"

# Words that say the role; of several roles the first one counts.
_ROLES = {
    SETPOINT: "setpoint sp wsp lsp rsp target reference ref desired goal soll sollwert "
    "fuhrungsgrosse fuehrungsgroesse consigne consigna riferimento referencia",
    COMMAND: "command cmd commands u q duty pwm op mv co stellgrosse stellgroesse stellwert "
    "stellsignal commande mando comando",
    MEASUREMENT: "measurement measured measure y pv actual sensor feedback ist istwert messwert "
    "gemessen regelgrosse regelgroesse mesure medida medido medicion misura adc encoder",
}
# Parts of a plant and quantities, which say it where no such word does and all say the same.
_PARTS = {
    COMMAND: "control input out output heater voltage volt power pump valve fan dac effort torque "
    "throttle actuator actuators esc drive ausgang heizung heizleistung leistung ventil pumpe "
    "lufter luefter spannung sortie vanne pompe chauffage puissance ventilateur salida valvula "
    "bomba calefactor potencia uscita valvola pompa riscaldatore potenza saida aquecedor uitgang "
    "klep pomp verwarming",
    MEASUREMENT: "t temp temperature rpm speed velocity omega position angle level height flow "
    "pressure distance humidity temperatur druck durchfluss fullstand fuellstand drehzahl niveau "
    "debit vitesse temperatura presion caudal nivel velocidad pressione portata livello velocita "
    "pressao vazao temperatuur druk toerental",
}
_DATES = "date datetime datum fecha"
_TIMES = (
    f"{_DATES} time timestamp stamp clock elapsed millis micros ms us sec seconds zeit uhrzeit "
    "zeitstempel tempo tiempo hora temps heure horodatage czas tijd tid"
)

_BRACKETS = re.compile(r"\s*[\[(]\s*(?P<unit>[^\])]*?)\s*[\])]\s*$")
# At the end of a name without brackets; letters that may as well number a part are no unit.
_BARE = re.compile(
    r"(?:[\s_]+|(?=%))(?P<unit>%|pct|percent|prozent|deg ?[CFK]?|°[CFK]?|[kMm]?Pa|m?bar|psi|rpm|"
    r"mV|[kM]?Hz|[kM]W|mA|l/min|l/h|m3/h|m³/h|kg/h|t/h)\s*$"
)
_PERCENT = ("pct", "percent", "prozent")
# Units of temperatures, pressures and speeds, in which nobody commands an actuator.
_OF_SENSORS = re.compile(r"(deg ?|°)[CFK]|[kMm]?Pa|m?bar|psi|rpm")


def words_of(name: str) -> frozenset[str]:
    """Return the words of a name without its unit, without digits and accents, in lower case."""
    plain = unicodedata.normalize("NFKD", _spaced(name).casefold())
    letters = "".join(c for c in plain if not unicodedata.combining(c))
    return frozenset(re.findall(r"[^\W\d_]+", letters))


def _spaced(name: str) -> str:
    """Return a name without its unit, and with a space before a capital within a word."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", without_unit(name))


def role_of(name: str) -> str | None:
    """Return what a name says: set-point, command, measurement, or None.

    >>> role_of("TIC201.PV (degC)"), role_of("Sollwert"), role_of("pump speed")
    ('measurement', 'set-point', None)
    >>> role_of("Heater (%)"), role_of("Zone 2 (°C)"), role_of("Heater (°C)"), role_of("Motor rpm")
    ('command', 'measurement', None, 'measurement')
    """
    words = words_of(name)
    if {"set", "point"} <= words:
        return SETPOINT
    said = _said(words, _ROLES)
    if said:
        return said[0]
    parts = {*_said(words, _PARTS), *[MEASUREMENT] * bool(_OF_SENSORS.fullmatch(unit_in(name)))}
    return parts.pop() if len(parts) == 1 else None


def tag_of(name: str) -> str:
    """Return a name without the word that says its role, with digits; empty: it has no other.

    >>> tag_of("TIC-101.PV (degC)"), tag_of("OUT TIC101"), tag_of("Heater (%)")
    ('tic 101', 'tic 101', '')
    >>> tag_of("yEst"), tag_of("uEst"), tag_of("T1"), tag_of("Q1")
    ('est', 'est', '1', '1')
    """
    words = re.findall(r"[^\W\d_]+|\d+", _spaced(name).casefold())
    return " ".join(word for word in words if role_of(word) is None)


def _said(words: frozenset[str], table: Mapping[str, str]) -> list[str]:
    return [role for role, known in table.items() if not words.isdisjoint(known.split())]


def is_time(name: str) -> bool:
    """Return whether a column is called like a time; "T" and "t1" are temperatures."""
    return (
        not words_of(name).isdisjoint(_TIMES.split()) or re.match(r"t(?![^\W_])", name) is not None
    )


def is_date(name: str) -> bool:
    """Return whether a column is called like a date."""
    return not words_of(name).isdisjoint(_DATES.split())


def without_unit(name: str) -> str:
    """Return a name without the unit at its end."""
    return _BARE.sub("", _BRACKETS.sub("", name))


def unit_in(name: str) -> str:
    """Return the unit at the end of a name; empty: it has none.

    >>> unit_in("PIC7_CV_pct"), unit_in("T3 degC"), unit_in("TI4 [DEG F]"), unit_in("Pump 2")
    ('%', 'degC', 'degF', '')
    """
    match = _BRACKETS.search(name) or _BARE.search(name)
    unit = match["unit"] if match else ""
    # Units are shown as one word each.
    unit = re.sub(r"(?i)^deg +([cfk])$", lambda degree: f"deg{degree[1].upper()}", unit)
    return "%" if unit.lower() in _PERCENT else unit


def doubts_about(measurement: str | None, command: str | None) -> list[str]:
    """Return sentences on signals that were chosen and are called like something else.

    :param measurement: the choice; None: none was made.
    :param command: likewise.
    """
    given = {MEASUREMENT: measurement, COMMAND: command}
    roles = {flag: role_of(name) for flag, name in given.items() if name is not None}
    found = [
        f"--{flag} {given[flag]!r} is called like a set-point; expected "
        + ("what the controller puts out" if flag == COMMAND else "what the sensor measures")
        for flag, role in roles.items()
        if role == SETPOINT
    ]
    if roles == {MEASUREMENT: COMMAND, COMMAND: MEASUREMENT}:
        found.append(
            f"--measurement {measurement!r} is called like a command and --command {command!r} "
            "like a measurement: exchange them, unless the names are wrong"
        )
    return found
