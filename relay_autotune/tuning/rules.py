"""Tuning rules for PI control, each with its source and where it applies."""

from __future__ import annotations

from relay_autotune.errors import TuningError
from relay_autotune.models import TransferFunction
from relay_autotune.tuning.gains import Controller
from relay_autotune.ultimate import UltimatePoint, ultimate_point

_ITAE_RANGE = (0.1, 1.0)


def tyreus_luyben(model: TransferFunction) -> tuple[Controller, str]:
    """Return PI gains by Tyreus and Luyben (Thyagarajan and Yu 2003, eqs 31 and 32).

    ``kc = K_u/3.2``, ``ti = 2.2 P_u``, with the ultimate point of the model itself.

    :param model: any process with an ultimate point.
    :raises TuningError: if it has none.
    """
    point = _ultimate(model)
    reason = f"Tyreus-Luyben: K_u/3.2 and 2.2 P_u with K_u = {point.gain:.4g}"
    return Controller(point.gain / 3.2, 2.2 * point.period), reason


def itae(model: TransferFunction) -> tuple[Controller, str]:
    """Return PI gains of minimum ITAE by Rovira (Thyagarajan and Yu 2003, eqs 33 and 34).

    ``kc = 0.586/K (tau/D)^0.916``, ``ti = tau/(1.03 - 0.165 D/tau)``, for 0.1 <= D/tau <= 1.

    :param model: a stable FOPDT process.
    :raises TuningError: outside that range, or for another structure.
    """
    gain, tau, dead_time = _fopdt("itae", model)
    ratio = dead_time / tau
    low, high = _ITAE_RANGE
    if not low * (1.0 - 1e-9) <= ratio <= high * (1.0 + 1e-9):
        raise TuningError(
            f"the ITAE rule holds for 0.1 <= D/tau <= 1, found {ratio:.3g}: use tyreus_luyben "
            "below, imc above, or thyagarajan to have it chosen"
        )
    reason = f"minimum ITAE (Rovira) for D/tau = {ratio:.3g}"
    return Controller(0.586 / gain * ratio**-0.916, tau / (1.03 - 0.165 * ratio)), reason


def imc(model: TransferFunction) -> tuple[Controller, str]:
    """Return PI gains by internal model control (Thyagarajan and Yu 2003, eqs 35 to 37).

    ``lambda = max(1.7 D, 0.2 tau)``, ``kc = (tau + D/2)/(K lambda)``, ``ti = tau + D/2``. The
    paper's Table 4 prints ``tau + D`` in kc, which is wrong.

    :param model: a stable FOPDT process.
    :raises TuningError: for another structure.
    """
    gain, tau, dead_time = _fopdt("imc", model)
    closed = max(1.7 * dead_time, 0.2 * tau)
    reason = f"IMC with lambda = {closed:.4g} s"
    return Controller((tau + 0.5 * dead_time) / (gain * closed), tau + 0.5 * dead_time), reason


def thyagarajan(model: TransferFunction) -> tuple[Controller, str]:
    """Return PI gains by the rule that D/tau asks for (Thyagarajan and Yu 2003, Table 4).

    Tyreus-Luyben for D/tau < 0.1, minimum ITAE up to 1, IMC above.

    :param model: a stable FOPDT process.
    :raises TuningError: for another structure.
    """
    _, tau, dead_time = _fopdt("thyagarajan", model)
    ratio = dead_time / tau
    low, high = _ITAE_RANGE
    chosen = tyreus_luyben if ratio < low else itae if ratio <= high else imc
    controller, reason = chosen(model)
    return controller, f"chosen by D/tau = {ratio:.3g}: {reason}"


def _ultimate(model: TransferFunction) -> UltimatePoint:
    point = ultimate_point(model)
    if point is None:
        raise TuningError(
            "the rule needs an ultimate point and the model has none (no gain makes it "
            "oscillate): use imc"
        )
    return point


def _fopdt(rule: str, model: TransferFunction) -> tuple[float, float, float]:
    if model.structure != "fopdt":
        raise TuningError(f"the rule {rule} is for a stable FOPDT model, found {model.structure}")
    return model.gain, model.time_constants[0].real, model.dead_time
