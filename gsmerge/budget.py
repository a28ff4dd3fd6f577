"""Numbers of Gaussians that budgets, file sizes and devices ask for or allow."""

from __future__ import annotations

from dataclasses import dataclass

from gsmerge.errors import UsageError
from gsmerge.io.formats.table import PLY, Format, count_for_bytes, output_format
from gsmerge.settings.budget import AUTO, DEVICES, BudgetOptions, parse_budget, parse_bytes

LEVEL_FACTOR = 4  # each level of detail has this many times fewer Gaussians than the one before


def exact_count(options: BudgetOptions, num_input: int, sh_degree: int) -> int | None:
    """Return the number of Gaussians that a budget or a file size asks for; None without either."""
    device = DEVICES.get(str(options.budget))
    if device is not None:  # a limit alone, until it is known how many the scene bears, unless it is to be filled
        known = [num_input] if options.fill else [] if options.most is None else [options.most]
        return min(device, *known) if known else None
    if options.budget in (None, AUTO):
        return None
    most = num_input if options.most is None else options.most
    if size := file_size(options):
        return min(count_for_bytes(size.file, size.num_bytes, sh_degree), most)
    return min(parse_budget(str(options.budget), num_input), most)


@dataclass(frozen=True)
class FileSize:
    """A size in bytes that the output may have."""

    num_bytes: int
    file: Format  # of the output

    @property
    def packed(self) -> bool:
        """Whether the bytes depend on the content, so that only trials tell them."""
        return self.file.count is None


def file_size(options: BudgetOptions) -> FileSize | None:
    """Return the size that a budget in bytes asks for; None for any other, UsageError where no format counts them."""
    if not options.in_bytes:
        return None
    file = output_format(options.output or PLY.ending, levels=True, cameras=True)
    if not file.each:
        raise UsageError(f"budget: expected a number or a share of Gaussians for {file.ending}, got {options.budget}")
    return FileSize(parse_bytes(str(options.budget)), file)


def max_allowed(options: BudgetOptions, num_input: int, sh_degree: int) -> int:
    """Return the largest number of Gaussians that budget, file size or device allow, at most that of the input."""
    limits = DEVICES.get(str(options.budget)), exact_count(options, num_input, sh_degree), options.most
    return min([num_input, *(limit for limit in limits if limit is not None)])
