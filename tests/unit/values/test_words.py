"""Words of messages follow their numbers."""

from gsmerge.values.words import count_words


def test_count_of_one_is_singular() -> None:
    numbers = 0, 1, 2, 1200
    assert [count_words(number, "row") for number in numbers] == ["0 rows", "1 row", "2 rows", "1,200 rows"]


def test_noun_that_ends_with_ch_takes_es() -> None:
    assert count_words(2, "batch") == "2 batches"


def test_words_behind_the_noun_stay_as_they_are() -> None:
    assert count_words(1, "empty row", "set aside") == "1 empty row set aside"
