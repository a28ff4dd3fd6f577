"""Arguments of kernels are checked before the call."""

import numpy as np
import pytest
from messages import refuses

from gsmerge.method.kernels.raster.binning import MOST_TILES, count_boxes, deal_tiles, sort_bits
from gsmerge.method.kernels.raster.project import CAMERA, cull
from gsmerge.method.kernels.signature import FilledTable, Table, f4


def arrays(m=3):
    return [np.arange(m, dtype=np.uint32), np.empty(m, np.int32), np.empty(m, np.uint64), np.empty(m, np.uint64)]


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda a: a.astype(np.int64), id="type"),
        pytest.param(lambda a: a[:-1], id="length"),
        pytest.param(lambda a: a[None], id="axes"),
        pytest.param(lambda a: np.repeat(a, 2)[::2], id="strides"),
        pytest.param(lambda a: a.tolist(), id="list"),
        pytest.param(lambda a: None, id="none"),
        pytest.param(lambda a: a.astype(a.dtype.newbyteorder()), id="byte order"),
    ],
)
@pytest.mark.parametrize("position", range(4))
def test_arrays_of_another_kind_are_refused(position, change):
    values = arrays()
    values[position] = change(values[position])
    with pytest.raises(ValueError, match="sort_bits: "):
        sort_bits(*values)


def test_unaligned_arrays_are_refused():
    values = arrays()
    values[1] = np.empty(4 * 3 + 1, np.uint8)[1:].view(np.int32)
    with pytest.raises(ValueError, match="aligned"):
        sort_bits(*values)


def test_arrays_that_cannot_be_written_are_refused():
    values = arrays()
    values[1].flags.writeable = False
    with refuses(ValueError, "sort_bits: order", "aligned"):
        sort_bits(*values)


def test_arguments_may_be_named():
    bits, order, keys, spare = arrays()
    sort_bits(bits, order, spare=spare, keys=keys)
    assert order.tolist() == [0, 1, 2]


def test_scalars_have_ranges():
    with refuses(ValueError, "count_boxes: tile_height", -1):
        count_boxes(np.zeros((0, 4), np.int16), -1, 1, np.zeros(0, np.int64), np.zeros(0, np.int64))


@pytest.mark.parametrize("start", [2**31, 2**32 + 1, -(2**31) - 1, 2**64])
def test_integers_beyond_the_type_in_c_are_refused(start):
    rows, opacities = np.zeros((1, 3), np.float32), np.zeros(1, np.float32)
    with refuses(ValueError, "cull: start", start):
        cull(rows, rows, opacities, None, None, np.zeros(CAMERA, np.float32), start, np.zeros(1, np.int32))


@pytest.mark.parametrize("tiles", [MOST_TILES + 1, 2**62, 2**63 - 1])
def test_more_tiles_than_boxes_can_name_are_refused(tiles):
    boxes, counts = np.zeros((1, 4), np.int16), np.zeros(1, np.int64)
    for side, height, width in (("height", tiles, 1), ("width", 1, tiles)):
        with refuses(ValueError, f"count_boxes: tile_{side}", tiles):
            count_boxes(boxes, height, width, counts, counts.copy())
    with refuses(ValueError, "deal_tiles: tile_width", tiles):
        deal_tiles(np.zeros(1, np.int32), boxes, tiles, counts, np.zeros(1, np.int32))


@pytest.mark.parametrize("box", [(0, 3, 0, 1), (0, 1, 0, 3), (-1, 1, 0, 1), (2, 1, 0, 1), (0, 1, 2, 1)])
def test_indices_outside_their_arrays_are_refused(box):
    with refuses(ValueError, "count_boxes", "indices"):
        count_boxes(np.array([box], np.int16), 2, 2, np.zeros(9, np.int64), np.zeros(4, np.int64))


@pytest.mark.parametrize("cursor", [-1, 1, 1 << 62, 2**63 - 1])
def test_a_cursor_outside_the_list_is_refused(cursor):
    cursors, flatten_ids = np.full(4, cursor), np.zeros(1, np.int32)
    with refuses(ValueError, "deal_tiles", "indices"):
        deal_tiles(np.zeros(1, np.int32), np.array([[0, 1, 0, 1]], np.int16), 2, cursors, flatten_ids)


def test_a_prepared_call_works_on_the_arrays_that_it_was_given():
    values = arrays()
    values[0][:] = [2, 1, 0]
    call = sort_bits.prepare(*values)
    call()
    assert values[1].tolist() == [2, 1, 0]
    values[0][:] = [0, 2, 1]
    call()
    assert values[1].tolist() == [0, 2, 1]
    with refuses(ValueError, "sort_bits: order"):
        sort_bits.prepare(values[0], values[1].astype(np.int64), *values[2:])


def test_tables_check_what_they_point_to():
    table = Table("Pair", ("count",), first=f4("n", 2), second=f4("n", out=True))
    arrays = {"first": np.zeros((3, 2), np.float32), "second": np.zeros(3, np.float32)}
    filled = FilledTable(table, arrays)
    assert filled["n"] == 3
    assert filled["count"] == 0
    assert filled["second"] == arrays["second"].ctypes.data
    filled["count"] = 7
    assert filled.values[-1] == 7
    with refuses(ValueError, "Pair: second", "n = 3"):
        filled.point("second", np.zeros(4, np.float32))
    with refuses(ValueError, "Pair: second"):
        FilledTable(table, arrays | {"second": np.zeros(4, np.float32)})
