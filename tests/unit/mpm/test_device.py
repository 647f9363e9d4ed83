"""GPUs of a host by name."""

import pytest

from nsf.mpm.device import visible_gpus


@pytest.mark.parametrize(
    ("named", "count", "expected"),
    [(None, 2, ("0", "1")), ("3, GPU-5a", 2, ("3", "GPU-5a")), ("0,-1,1", 1, ("0",)), ("", 0, ())],
)
def test_gpus_by_name(monkeypatch, named, count, expected):
    monkeypatch.setattr("nsf.mpm.device.wp.get_cuda_devices", lambda: [object()] * count)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if named is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", named)
    assert visible_gpus() == expected
