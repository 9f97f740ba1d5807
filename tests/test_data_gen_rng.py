"""Random streams: the Sobol' set is the published one, addresses are independent, numbers are uniform."""

import numpy as np
import pytest
from scipy import stats
from scipy.stats import qmc

from data_gen.rng import MAX_SAMPLES, SOBOL_DIMENSIONS, SampleStream, generator, sobol_words


def test_sobol_words_are_scipys_set():
    ours = sobol_words(0, 1024)
    theirs = (qmc.Sobol(SOBOL_DIMENSIONS, scramble=False, bits=32).random(1024).T * 2**32).astype(np.uint32)
    assert {tuple(p) for p in ours.T} == {tuple(p) for p in theirs.T}


def test_rounds_continue_the_sequence():
    np.testing.assert_array_equal(
        np.concatenate([sobol_words(0, 16), sobol_words(16, 16)], 1), sobol_words(0, 32)
    )


def test_last_points_use_every_direction():
    # the first MAX_SAMPLES points of each dimension are a permutation of the multiples of 1/MAX_SAMPLES
    words = sobol_words(0, MAX_SAMPLES)
    for row in words:
        np.testing.assert_array_equal(np.sort(row), np.arange(MAX_SAMPLES, dtype=np.uint64) * (2**32 // MAX_SAMPLES))


@pytest.mark.parametrize(("first", "count"), [(0, 0), (-1, 4), (MAX_SAMPLES, 1)])
def test_sobol_range_is_checked(first, count):
    with pytest.raises(ValueError, match="samples: expected a range within"):
        sobol_words(first, count)


def test_stream_repeats_and_addresses_differ():
    a = SampleStream(7, 1, 2, groups=50, samples=8)
    b = SampleStream(7, 1, 2, groups=50, samples=8)
    c = SampleStream(7, 1, 3, groups=50, samples=8)
    np.testing.assert_array_equal(a.uniform(0, 4), b.uniform(0, 4))
    np.testing.assert_array_equal(a.independent(9), b.independent(9))
    assert not np.array_equal(a.uniform(0, 4), c.uniform(0, 4))
    with pytest.raises(ValueError, match="seed"):
        generator(-1)


def test_subset_of_paths_is_the_subset_of_all():
    stream = SampleStream(1, groups=20, samples=4)
    paths = np.array([0, 3, 17, 79])
    np.testing.assert_array_equal(stream.uniform(2, 2, paths), stream.uniform(2, 2)[:, paths])


@pytest.mark.parametrize("dimension", [0, 6, SOBOL_DIMENSIONS - 2, SOBOL_DIMENSIONS])
def test_numbers_are_uniform_over_replicates(dimension):
    # one number per replicate: the shift alone has to make it uniform and the two dimensions independent
    u = SampleStream(3, groups=20000, samples=1).uniform(dimension, 2)
    assert u.dtype == np.float32 and u.min() >= 0 and u.max() < 1
    counts, _, _ = np.histogram2d(u[0], u[1], bins=10, range=[[0, 1], [0, 1]])
    assert stats.chisquare(counts.ravel()).pvalue > 1e-3


def test_each_replicate_is_stratified():
    u = SampleStream(5, groups=3, samples=16).uniform(0, 1).reshape(3, 16)
    for replicate in u:
        np.testing.assert_array_equal(np.sort((replicate * 16).astype(int)), np.arange(16))
