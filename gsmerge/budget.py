"""Numbers of Gaussians that budgets, file sizes and devices ask for or allow."""

from __future__ import annotations

from gsmerge.io.formats.ply import count_for_bytes
from gsmerge.settings.budget import AUTO, DEVICES, BudgetOptions, parse_budget, parse_bytes


def exact_count(options: BudgetOptions, num_input: int, sh_degree: int) -> int | None:
    """Return the number of Gaussians that a budget or a file size asks for; None without either."""
    if options.budget in (None, AUTO, *DEVICES):
        return None
    if options.in_bytes:
        return min(count_for_bytes(parse_bytes(str(options.budget)), sh_degree), num_input)
    return parse_budget(str(options.budget), num_input)


def max_allowed(options: BudgetOptions, num_input: int, sh_degree: int) -> int:
    """Return the most Gaussians that a budget, a file size or a device allows, at most the input's."""
    limit = DEVICES.get(str(options.budget), exact_count(options, num_input, sh_degree))
    return num_input if limit is None else min(limit, num_input)
