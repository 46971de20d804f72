"""Flows of one grid with other values."""

from dataclasses import replace

from vstent.flow.case import FlowField


def with_values(field: FlowField, **values: object) -> FlowField:
    """Return a flow of one level with other values in its cells."""
    (level,) = field.levels
    return replace(field, levels=(replace(level, **values),))  # type: ignore[arg-type]
