"""Numbers of Gaussians that budgets, file sizes and devices ask for or allow."""

from __future__ import annotations

from dataclasses import dataclass

from gsmerge.io.formats.table import PLY, Format, count_for_bytes, output_format
from gsmerge.settings.budget import AUTO, DEVICES, BudgetOptions, parse_budget, parse_bytes

LEVEL_FACTOR = 4  # each level of detail has this many times fewer Gaussians than the one before


def exact_count(options: BudgetOptions, num_input: int, sh_degree: int) -> int | None:
    """Return the number of Gaussians that a budget or a file size asks for; None without either."""
    if options.budget in (None, AUTO, *DEVICES):
        return None
    if size := file_size(options):
        return min(count_for_bytes(size.file, size.finest, sh_degree), num_input)
    return parse_budget(str(options.budget), num_input)


@dataclass(frozen=True)
class FileSize:
    """A size in bytes that the output may have."""

    num_bytes: int
    file: Format  # of the output
    levels: int = 1  # that are in it, each see LEVEL_FACTOR

    @property
    def packed(self) -> bool:
        """Whether the bytes depend on the content, so that only trials tell them."""
        return self.file is not PLY

    @property
    def finest(self) -> int:
        """Approximate bytes that are left for the finest level."""
        return int(self.num_bytes / sum(LEVEL_FACTOR**-level for level in range(self.levels)))


def file_size(options: BudgetOptions) -> FileSize | None:
    """Return the size that a budget in bytes asks for; None for any other budget."""
    if not options.in_bytes:
        return None
    file = output_format(options.output or PLY.ending, levels=True)
    in_one = file.encode is None and file is not PLY
    return FileSize(parse_bytes(str(options.budget)), file, options.levels if in_one else 1)


def max_allowed(options: BudgetOptions, num_input: int, sh_degree: int) -> int:
    """Return the largest number of Gaussians that budget, file size or device allow, at most that of the input."""
    limit = DEVICES.get(str(options.budget), exact_count(options, num_input, sh_degree))
    return num_input if limit is None else min(limit, num_input)
