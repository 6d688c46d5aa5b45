"""Films an episode, and writes it as a video."""

from __future__ import annotations

import html
import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coop.common.bounds import MAX_VIDEO
from coop.common.envs.make import make_filmed_env
from coop.common.errors import RunError, UsageError
from coop.common.places import absolute
from coop.common.settings.environment import EnvSettings
from coop.evaluation.episodes import Acting, chosen
from coop.evaluation.notebook import image_html

Picture = NDArray[np.uint8]
"""uint8 [height, width, 3]."""

SMALLEST = 240  # pixels: smaller pictures are enlarged
MOST = 9000  # pictures, and so steps, of any film; ten minutes of an Atari game
LONGEST = 900  # of one that goes to TensorBoard
LONGEST_GIF = 3000  # of a GIF, which is made in memory
LONGEST_S = 3600  # seconds of any film, where pictures are slow
LONGEST_STILL = 600_000  # milliseconds of one picture; a GIF has 16 bits for hundredths of a second
FORMATS = (".mp4", ".gif")


class Film:
    """The pictures of an episode in which `act` chooses the actions, as they are played, up to `MOST` or `LONGEST_S`.

    pictures_per_s: at the game's usual speed. steps, episode_return: of what has been played so far. over: the episode
    has ended; False behind the last picture of one that was cut.
    """

    def __init__(self, act: Acting, settings: EnvSettings, seed: int) -> None:
        """Raise UsageError as `make_filmed_env`."""
        self._act = act
        self._env = make_filmed_env(settings, seed)
        self.pictures_per_s = self._env.pictures_per_s
        self.steps, self.episode_return, self.over = 0, 0.0, False

    def __iter__(self) -> Iterator[Picture]:
        """Yield a picture of each state in which the policy acts."""
        return self.pictures(MOST)

    def pictures(self, most: int) -> Iterator[Picture]:
        """Yield the first pictures, at most so many."""
        most = max(1, min(most, MOST, int(LONGEST_S * self.pictures_per_s)))
        try:
            obs = self._env.reset()
            while not self.over and self.steps < most:
                yield _enlarged(self._env.picture())
                steps = self._env.step(chosen(self._act, obs, self._env.spec, self._env.mask))
                obs, self.over = steps.obs, bool(steps.episode_over[0])
                self.steps += 1
                self.episode_return += float(steps.raw_rewards[0])
        finally:
            self._env.close()


@dataclass(frozen=True, repr=False)
class Clip:
    """A film of an episode.

    Attributes:
        gif: an animated GIF.
        steps, episode_return: of what has been filmed. over: the episode has ended within it.
    """

    gif: bytes
    steps: int
    episode_return: float
    over: bool

    @classmethod
    def of(cls, film: Film) -> Clip:
        """Play a film."""
        gif = short_gif(film)
        return cls(gif, film.steps, film.episode_return, film.over)

    def save(self, path: str | Path) -> None:
        """Write the GIF to a file; raises UsageError for no path, RunError if it can't be written."""
        try:
            absolute(path).write_bytes(self.gif)
        except OSError as error:
            raise RunError(f"{path}: {error.strerror or error}") from error

    def __repr__(self) -> str:
        how = "" if self.over else ", which goes on"
        return f"<film of {self.steps:,} steps, return {self.episode_return:g}{how}>"

    def _repr_html_(self) -> str:
        return f"{image_html(self.gif, 'gif')}<br>{html.escape(repr(self).strip('<>'))}"


def check_video(path: Path) -> None:
    """Raise UsageError for a video that can't be written here."""
    if path.suffix not in FORMATS:
        raise UsageError(f"--video {path}: must end in {' or '.join(FORMATS)}")
    if not path.parent.is_dir():
        raise UsageError(f"--video {path}: there is no folder {path.parent}")
    if path.suffix == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401, PLC0415
        except ImportError:
            raise UsageError(f"--video {path}: needs imageio-ffmpeg (the extra `video`); a .gif does not") from None


def write_video(film: Film, path: Path) -> None:
    """Write an episode to a file of one of `FORMATS`; a GIF holds at most `LONGEST_GIF` pictures of it."""
    if path.suffix == ".gif":
        path.write_bytes(_gif(film.pictures(LONGEST_GIF), film.pictures_per_s))
        return
    import imageio_ffmpeg  # noqa: PLC0415

    pictures = iter(film)
    first = next(pictures)
    height, width, _ = first.shape
    writer = imageio_ffmpeg.write_frames(path, (width, height), fps=film.pictures_per_s, macro_block_size=2, quality=8)
    writer.send(None)
    try:
        for picture in chain([first], pictures):
            writer.send(np.ascontiguousarray(picture))
    except BaseException:
        writer.close()
        path.unlink(missing_ok=True)
        raise
    writer.close()


def short_gif(film: Film) -> bytes:
    """The first `LONGEST` pictures of an episode as an animated GIF of at most `MAX_VIDEO` bytes."""
    pictures = list(film.pictures(LONGEST))
    while len(content := _gif(pictures, film.pictures_per_s)) > MAX_VIDEO:
        pictures = pictures[: len(pictures) // 2]
    return content


def _gif(pictures: Iterable[Picture], per_s: float) -> bytes:
    from PIL import Image  # noqa: PLC0415 (needed seldom)

    content, duration = io.BytesIO(), round(1000 / per_s)
    images = map(Image.fromarray, _moving(pictures, duration))
    next(images).save(content, "gif", save_all=True, append_images=images, duration=duration, loop=0)
    return content.getvalue()


def _moving(pictures: Iterable[Picture], duration: int) -> Iterator[Picture]:
    """Leave out pictures, of so many milliseconds each, with which one that stays the same would last too long."""
    before, still = None, 0
    for picture in pictures:
        still = still + duration if before is not None and np.array_equal(picture, before) else duration
        before = picture
        if still <= LONGEST_STILL:
            yield picture


def _enlarged(picture: Picture) -> Picture:
    """The picture, or a whole multiple of a small one; height and width become even, as videos need them."""
    times = max(1, -(-SMALLEST // min(picture.shape[:2])))
    large = picture.repeat(times, axis=0).repeat(times, axis=1)
    return np.pad(large, ((0, large.shape[0] % 2), (0, large.shape[1] % 2), (0, 0)))
