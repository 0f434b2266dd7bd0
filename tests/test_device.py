"""Streams of devices, without a GPU."""

import torch

from turbogs_plugin import device as devices


def test_the_object_of_a_stream_is_made_once(monkeypatch):
    """The stream is torch's current one at each call, of the device asked for."""
    current, made = {0: (7, 0, 1), 1: (0, 1, 1)}, []
    monkeypatch.setattr(torch._C, "_cuda_getCurrentStream", lambda index: current[index], raising=False)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    monkeypatch.setattr(torch.cuda, "Stream", lambda **ids: made.append(ids) or tuple(ids.values()))
    devices._stream.cache_clear()
    for index, stream in ((0, (7, 0, 1)), (1, (0, 1, 1)), (0, (7, 0, 1)), (0, (8, 0, 1)), (0, (7, 0, 1))):
        current[index] = stream
        assert devices.current_stream(torch.device("cuda", index)) == stream
    assert devices.current_stream(torch.device("cuda")) == (0, 1, 1)
    names = ("stream_id", "device_index", "device_type")
    assert made == [dict(zip(names, ids, strict=True)) for ids in ((7, 0, 1), (0, 1, 1), (8, 0, 1))]
    devices._stream.cache_clear()
