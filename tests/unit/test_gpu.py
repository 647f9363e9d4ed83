"""What concerns a GPU, on a machine without one."""

import gc

import pytest

from nsf.gpu import without_collection


def test_garbage_is_left_alone_and_collected_again_after():
    assert gc.isenabled()
    with without_collection():
        assert not gc.isenabled()
        with without_collection():
            pass
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(KeyError), without_collection():
        raise KeyError
    assert gc.isenabled()
