"""The dictionaries of `estimate` as typed results."""

from typing import Any, cast

import msgspec

from ..analysis.prediction import Predictions
from ..identification.results import (
    ChannelFit,
    Constant,
    FlightIdentification,
    HeldParameter,
    Identification,
    ParameterEstimate,
    PredictionSkill,
    RigidBody,
    Validation,
    VehicleIdentification,
)


def typed(report: dict[str, Any], predicted: Predictions | None = None) -> Identification:
    """What `to_dict` gives, back as an identification; without its arrays."""
    names = ("estimator", "model", "result", "rollouts", "cost", "seconds", "provenance")
    constants = {name: row for name, row in report["constants"].items() if isinstance(row, dict)}
    common = {name: report[name] for name in names} | {
        "parameters": msgspec.convert(report["parameters"], dict[str, ParameterEstimate]),
        "rigid_body": RigidBody(
            msgspec.convert(constants, dict[str, Constant]),
            report["constants"].get("consistency_p"),
            report["constants"].get("rigid_body"),
        ),
        "estimate": cast(Any, None),
        "problem": cast(Any, None),
    }
    if "held" not in report:
        return FlightIdentification(
            **common,
            fit=msgspec.convert(report["fit"], dict[str, ChannelFit]),
            validation=msgspec.convert(report["validation"], Validation | None),
        )
    return VehicleIdentification(
        **common,
        held=msgspec.convert(report["held"], dict[str, HeldParameter]),
        cut=report["cut"],
        noise=report["noise"],
        skill=msgspec.convert(report["skill"], PredictionSkill | None),
        predictions=predicted,
    )
