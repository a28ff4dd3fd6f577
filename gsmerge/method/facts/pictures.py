"""Names, in messages, of the pictures to which results are fitted and with which they are compared."""

from __future__ import annotations

# Names, in messages, of the pictures to which results are fitted and with which they are compared. Without photos,
# these pictures are the colours of the rows, or renders if the rows belong to no pixels
OWN_PHOTOS = "the scene's own photos"
PHOTOS = "photos"
ROW_COLORS = "the model's own pixels"
RENDERS = "renders of the input"
