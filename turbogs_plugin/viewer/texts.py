"""What the page says: each picture in a sentence or two, and the method for whoever sees it for the first time."""

from __future__ import annotations

import re

from turbogs_plugin.viewer.pictures import Picture

PICTURES = {
    Picture.RENDER: "The model from where you are. Drag to turn, scroll to come nearer. *Cameras of the capture* shows "
    "where its photos were taken: click one to stand there.",
    Picture.DEPTH: "How far away things are. Near is bright.",
    Picture.TILES: "The image is drawn in tiles of 16x16 pixels. Bright tiles are reached by many Gaussians: there "
    "rendering takes longest.",
    Picture.CHANGES: "**Green**: Gaussians that the last event of density control added, where more detail was wanted. "
    "**Red**: those that it removed. Grey: all others.",
    Picture.COMPARE: "A view of the capture: the photo, what the model makes of it, and the difference (bright is "
    "wrong).",
    Picture.PHOTO: "The photo itself.",
    Picture.ERRORS: "What training remembers of each pixel's error, a mean over its last visits. Bright pixels are "
    "drawn more often.",
    Picture.AGES: "How long ago each pixel was last looked at. Black: just now. Bright: long ago, so it will be drawn "
    "soon, even if its error was small.",
    Picture.SAMPLES: "**Orange**: the pixels that this iteration renders and learns from. All others cost nothing "
    "this time.",
}

METHOD = """
**What you see.** Photos of a place become a model of it: many soft coloured blobs, *Gaussians*. Drawn from a camera,
all of them together make an image. Training moves, turns, stretches and colours them until the images look like the
photos.

**Few pixels, well chosen.** Others draw a whole image, compare it with its photo, and do that thousands of times. Most
pixels are right early on and teach nothing more. TurboGS keeps a map of each photo: how wrong was each pixel when it
was last seen (*Error map*), and how long ago was that (*Age map*)? An iteration takes several photos at once, and of
each 16x16 tile only pixels with a large error or not seen for a long time (*Samples of this iteration*).

**More where it is wrong.** From time to time Gaussians are split or copied where the samples ask for more detail, and
useless ones are removed (*Added and removed*).
"""

TRY_IT = """
**Try it.** Pause the training, choose *Samples of this iteration*, and press *One step* a few times. Then look at the
*Error map* of the same view.
"""


def plain(name: str) -> str:
    """A file's name without what a page's Markdown could take for more than text: names come with captures."""
    return re.sub(r"[^\w ./()+,-]", "?", name)
