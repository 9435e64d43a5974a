"""Place recognition: the fixed vocabulary, the vectors of images, and the search among them."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.slam.place_recognition import PLACE_VECTOR_SIZE, VOCABULARY_FILE, PlaceIndex, place_vector
from tests.kit.synthetic_maps import make_world


def unit_vectors(n: int, seed: int = 1):
    vectors = np.random.default_rng(seed).normal(size=(n, PLACE_VECTOR_SIZE)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def index_of(vectors, ids=None) -> PlaceIndex:
    index = PlaceIndex()
    for number, vector in zip(range(len(vectors)) if ids is None else ids, vectors, strict=True):
        index.add(number, vector)
    return index


def test_the_vocabulary_is_small_enough_for_the_package():
    assert VOCABULARY_FILE.stat().st_size == 32 * 256 + 256 * 16


def test_a_vector_has_length_one_and_that_of_an_empty_view_is_zero():
    descriptors = np.random.default_rng(2).integers(0, 256, (700, 32), dtype=np.uint8)

    assert place_vector(descriptors).shape == (PLACE_VECTOR_SIZE,)
    assert np.linalg.norm(place_vector(descriptors)) == pytest.approx(1.0, abs=1e-6)
    assert not place_vector(descriptors[:0]).any()


def test_the_vector_of_descriptors_is_the_same_on_every_machine():
    descriptors = hashlib.shake_256(b"places").digest(894 * 32)
    vector = place_vector(np.frombuffer(descriptors, np.uint8).reshape(-1, 32))

    # Recorded once; whole numbers leave no room for another sum of the same terms.
    assert hashlib.sha256(vector.astype("<f4").tobytes()).hexdigest()[:16] == "0f5677433558e76c"


def test_the_order_of_features_changes_no_byte_of_the_vector():
    rng = np.random.default_rng(3)
    descriptors = rng.integers(0, 256, (300, 32), dtype=np.uint8)

    assert np.array_equal(place_vector(descriptors), place_vector(descriptors[rng.permutation(300)]))


def test_views_of_one_place_are_nearer_than_views_of_others():
    version, _ = make_world(4, points=4000).walk("r", np.linspace(0.0, 0.9, 31), seed=2)
    vectors = [place_vector(each.descriptors) for each in version.keyframes]
    index = index_of(vectors)

    near = 0
    for number, vector in enumerate(vectors):
        (itself, _), (other, _) = index.nearest(vector, 2)
        assert itself == number
        near += 1 <= abs(other - number) <= 2
    assert near >= 28  # of 31: descriptors that the vocabulary was not trained for


def test_the_most_similar_come_first_and_equals_by_id():
    vectors = unit_vectors(50)
    index = index_of([*vectors, vectors[7], vectors[7]])

    found = index.nearest(vectors[7], 5)

    assert [number for number, _ in found[:3]] == [7, 50, 51]
    expected = np.sort(vectors @ vectors[7])[::-1][1:3]
    np.testing.assert_allclose([cosine for _, cosine in found[3:]], expected, rtol=1e-5)


@pytest.mark.parametrize("count", [0, 1, 5, 100])
def test_only_what_is_allowed_is_found(count):
    vectors = unit_vectors(20)
    index = index_of(vectors, range(0, 40, 2))

    found = index.nearest(vectors[0], count, np.array([2, 4, 5, 38, 1000]))

    assert {number for number, _ in found} <= {2, 4, 38}
    assert len(found) == min(count, 3)


def test_what_is_removed_is_not_found_and_the_others_are():
    vectors = unit_vectors(200)
    index = index_of(vectors)
    for number in (0, 7, 199, 7):
        index.remove(number)

    assert len(index) == 197
    assert 7 not in index
    found = [number for number, _ in index.nearest(vectors[7], 300)]
    assert sorted(found) == sorted(set(range(200)) - {0, 7, 199})
    assert all(np.array_equal(index.vector_of(number), vectors[number]) for number in found)
    with pytest.raises(KeyError):
        index.vector_of(7)


def test_a_keyframe_is_added_once():
    index = index_of(unit_vectors(2))
    with pytest.raises(ValueError, match="already"):
        index.add(1, unit_vectors(1)[0])


def test_an_index_from_bytes_finds_the_same_however_it_came_to_be():
    vectors = unit_vectors(90)
    grown = index_of(vectors)
    for number in (3, 50, 89):
        grown.remove(number)
    direct = index_of(
        [vectors[n] for n in range(90) if n not in (3, 50, 89)], sorted(set(range(90)) - {3, 50, 89})
    )

    assert grown.to_bytes() == direct.to_bytes()
    again = PlaceIndex.from_bytes(grown.to_bytes())
    assert again.to_bytes() == grown.to_bytes()
    assert [n for n, _ in again.nearest(vectors[3], 9)] == [n for n, _ in grown.nearest(vectors[3], 9)]


def test_damaged_bytes_of_an_index_are_refused():
    with pytest.raises(BadRequest, match="not an index of places"):
        PlaceIndex.from_bytes(index_of(unit_vectors(2)).to_bytes()[:-1])
