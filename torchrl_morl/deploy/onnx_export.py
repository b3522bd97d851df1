"""Policies as ONNX files, which run without Python or PyTorch."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import logging
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_morl._extras import from_extra

from .entries import null_for_nan, one_line
from .files import check_new, weights_bytes, write_new
from .graph import PolicyGraph
from .lidar import LidarGeometry
from .onnx_runner import FORMAT
from .policy import Policy
from .sensing import NUM_ROBOT

__all__ = ["export_onnx", "training_lidar"]

_OPSET = 18
_TOLERANCE = 1e-4
"""Of a command, m/s and rad/s, by which file and policy may differ. They do by some 1e-6."""

_UNITS = {
    "ranges": {"entries": "one a beam", "unit": "m"},
    "goal": {"entries": ["distance", "bearing"], "unit": ["m", "rad"]},
    "human": {"entries": ["distance", "bearing"], "unit": ["m", "rad"]},
    "human_velocity": {"entries": ["ahead", "left"], "unit": ["m/s", "m/s"]},
    "motion": {
        "entries": [
            "speed and turn rate, measured",
            "those of the last four commands, latest first",
        ],
        "unit": ["m/s", "rad/s"],
    },
}


def training_lidar(
    policy: Policy, num_beams: int = 720, *, robot: Sequence[float] | None = None
) -> LidarGeometry:
    """A lidar as that of the training: all around, counter-clockwise from straight ahead.

    Args:
        policy: from :func:`load_policy`.
        num_beams: of the lidar.

    Keyword Args:
        robot: which one it is on, for policies that read it; six numbers say how far it sees and where
            it is.

    Raises:
        ValueError: for a policy that does not tell what it senses, or a robot that is refused.

    Example:
        >>> from torchrl_morl.testing import untrained_policy
        >>> lidar = training_lidar(untrained_policy())
        >>> lidar.num_beams, lidar.range_max, round(lidar.increment, 4)
        (720, 4.0, 0.0087)
    """
    if policy.sensing is None:
        raise ValueError("the file of this policy does not tell what it senses.")
    sensing = policy.sensing
    furthest = sensing.max_range
    if robot is not None and len(robot) == NUM_ROBOT and (numbers := sensing.robot(robot)):
        sensing, furthest = sensing.of_robot(numbers), max(furthest, numbers[4])
    return LidarGeometry(
        first_angle=0.0,
        increment=2 * np.pi / num_beams,
        num_beams=num_beams,
        range_min=0.0005,
        range_max=furthest,
        mount=(*sensing.lidar_origin, 0.0),
    )


def export_onnx(
    policy: Policy,
    file: str | Path,
    *,
    lidar: LidarGeometry,
    robot: Sequence[float] | None = None,
) -> Path:
    """Write a policy as one ONNX file: raw ranges, goal, human and preference in, command out.

    Sectors, features, clamps and limits are inside, in standard operators of opset 18; the batch is
    of any size. The file is compared with the policy by ONNX Runtime before it takes its name.

    An ONNX graph cannot refuse anything: NaN in is NaN out, and a preference off the simplex gives
    some command. :class:`~torchrl_morl.deploy.onnx_runner.OnnxRunner` stands before it, a file that
    needs NumPy and ONNX Runtime alone.

    ==================  ===========  ================================================================
    tensor              shape        meaning
    ==================  ===========  ================================================================
    ``ranges``          ``[B, N]``   of the scan, metres, in the order of ``lidar``
    ``goal``            ``[B, 2]``   distance (m) and bearing (rad)
    ``human``           ``[B, 2]``   the same; nobody is ``sensing.nobody``. For policies that read it
    ``human_velocity``  ``[B, 2]``   over the ground, ahead and to the left, m/s, likewise
    ``motion``          ``[B, 10]``  measured speed (m/s) and turn rate (rad/s), then those of the last
                                     four commands, the latest first, likewise
    ``preference``      ``[B, T]``   weights of the tunable objectives
    ``command``         ``[B, 2]``   the output: speed (m/s) and turn rate (rad/s)
    ==================  ===========  ================================================================

    The metadata, each entry a JSON value: ``torchrl_morl_format``, ``objectives``, ``static``,
    ``preference`` (order of its entries), ``inputs`` and ``outputs`` (with units), ``lidar``,
    ``sensing``, ``limits``, ``period``, ``robot``, ``card``, ``weights_sha256``.

    Args:
        policy: from :func:`load_policy`, with float32 weights.
        file: must not exist.

    Keyword Args:
        lidar: of the robot; its geometry becomes part of the file.
        robot: which one it is, for policies that read it, see :meth:`LidarGeometry.robot`;
            they become part of the file, too.

    Returns:
        The file.

    Raises:
        FileExistsError: if there is such a file.
        FileNotFoundError: if there is no folder for it.
        ImportError: without the extra ``export``.
        ValueError: for a policy that does not tell what it senses or is of float64, for a lidar too
            coarse for it, a robot that :meth:`LidarGeometry.robot` refuses, or where the file would not compute what the policy does.

    Example:
        >>> import math, tempfile
        >>> from torchrl_morl.testing import untrained_policy
        >>> lidar = LidarGeometry(-math.pi, math.pi / 180, 360, range_min=0.12, range_max=3.5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = export_onnx(untrained_policy(), f"{folder}/policy.onnx", lidar=lidar)
        ...     file.stat().st_size > 1000
        True
    """
    if not isinstance(policy, Policy):
        raise ValueError(f"policy must be a Policy, from load_policy, got {policy!r}.")
    if not isinstance(lidar, LidarGeometry):
        raise ValueError(f"lidar must be a LidarGeometry, got {lidar!r}.")
    path = Path(file)
    check_new(path)
    graph = PolicyGraph(policy, lidar, robot=robot).cpu().eval()
    if graph.dtype != torch.float32:
        raise ValueError(
            f"an ONNX file has float32 weights, this policy has {graph.dtype}: save it again after "
            "actor.float()."
        )
    with from_extra("export", "export_onnx"):
        import onnx
        import onnxruntime
        import onnxscript  # noqa: F401
    with _quiet():
        program = torch.onnx.export(
            graph,
            kwargs=_example(graph, batch=2, seed=0),
            input_names=list(graph.input_names),
            output_names=["command"],
            opset_version=_OPSET,
            dynamic_shapes={name: {0: torch.export.Dim("batch")} for name in graph.input_names},
            dynamo=True,
            verbose=False,
        )
    model = program.model_proto
    _strip(model)
    onnx.helper.set_model_props(model, _metadata(policy, lidar, graph))
    data = model.SerializeToString()
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    inputs = _example(graph, batch=64, seed=1)
    with torch.inference_mode():
        expected = graph(**inputs).numpy()
    (command,) = session.run(["command"], {name: x.numpy() for name, x in inputs.items()})
    difference = abs(command - expected).max()
    if not difference <= _TOLERANCE:
        raise ValueError(
            f"the ONNX file would not compute what the policy does: commands differ by {difference:g}. "
            "Nothing was written."
        )
    write_new(path, data)
    return path


def _metadata(policy: Policy, lidar: LidarGeometry, graph: PolicyGraph) -> dict[str, str]:
    """What an exported file tells of itself, every value as JSON."""
    space = policy.preference_space
    units: dict[str, Any] = {name: _UNITS[name] for name in graph.input_names if name in _UNITS}
    units["preference"] = {"entries": list(space.tunable), "unit": "1"}
    values = {
        "torchrl_morl_format": FORMAT,
        "objectives": list(space.objectives),
        "static": dict(space.static),
        "preference": list(space.tunable),
        "inputs": units,
        "outputs": {"command": {"entries": ["speed", "turn_rate"], "unit": ["m/s", "rad/s"]}},
        "lidar": dataclasses.asdict(lidar),
        "sensing": graph.sensing.to_json(),
        "limits": graph.limits.to_json(),
        "period": policy.period,
        "robot": policy.robot,
        # Of a policy that reads which one it drives: the one that this file is for.
        **({} if graph.robot is None else {"robot_numbers": graph.robot.tolist()}),
        "card": null_for_nan(policy.card),
        "weights_sha256": hashlib.sha256(weights_bytes(policy.actor)[0]).hexdigest(),
    }
    return {name: json.dumps(value, allow_nan=False) for name, value in values.items()}


def _example(graph: PolicyGraph, batch: int, seed: int) -> dict[str, torch.Tensor]:
    """Inputs within what was trained, all drawn alike."""
    generator = torch.Generator().manual_seed(seed)
    drawn = {
        name: torch.rand(batch, size, generator=generator)
        for name, size in graph.input_sizes.items()
    }
    drawn["ranges"] *= 2 * graph.sensing.max_range
    drawn["preference"] /= drawn["preference"].sum(-1, keepdim=True)
    for name in {"goal", "human"} & drawn.keys():
        drawn[name] = drawn[name] * 6 + 0.3
    return drawn


def _strip(model: Any) -> None:
    """Remove where in whose files the operators come from: it is nobody's business, and half of the file."""
    for part in (model.graph, *model.graph.node, *model.graph.value_info, *model.graph.input):
        del part.metadata_props[:]
    for part in (*model.graph.output, *model.graph.initializer):
        del part.metadata_props[:]
    for node in model.graph.node:
        node.doc_string = ""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without what the exporter tells its own developers; an error keeps its text."""
    names = ("torch.onnx", "onnxscript", "onnx_ir")
    levels = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    except torch.onnx.errors.OnnxExporterError as error:
        raise ValueError(f"this policy cannot be exported: {one_line(error)}") from error
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
