"""Training in memory, from Python."""

import torch

from turbogs_plugin.captures import load_scene
from turbogs_plugin.train.run import fit

SHORT = ("train.iterations=2", "train.refine_until=1", "train.device=cpu")


def test_a_folder_is_read_as_the_section_scene_says(capture):
    models = [fit(given, *SHORT, "scene.factor=2") for given in (str(capture), capture, load_scene(capture, 2))]
    whole = fit(load_scene(capture), *SHORT)
    for name, value in models[2].items():
        assert all(torch.equal(getattr(model, name), value) for model in models[:2])
    assert not torch.equal(whole.sh0, models[0].sh0)
