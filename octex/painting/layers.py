"""Layers: a Painter whose strokes go into layers above a texture."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from octex.channels import ALPHA, BASE_COLOR, alpha_of, plain_name
from octex.checks import as_flag, as_whole
from octex.editing.draft import Change, as_change, change_of_values, with_alpha
from octex.errors import ArgumentError
from octex.painting.composites import ERASED, Stacked, restored, without_erased
from octex.painting.image import Blend
from octex.painting.layer import painted_channel
from octex.painting.merge import merged
from octex.painting.paint import check_inside
from octex.painting.painter import History, Painter, Stroke
from octex.painting.stack import (
    Keep,
    Layer,
    LayerBlend,
    Stack,
    as_file,
    bottom_names,
    check_layer,
    composite_name,
    composited,
    from_file,
    shown,
    shown_names,
    united,
    with_composite,
    with_layer_channels,
)
from octex.painting.surface import Job
from octex.source.parts import SEPARATION
from octex.source.surface import Surface
from octex.texture import Channel, OctreeTexture, as_texture


class Restacked(NamedTuple):
    """A change of the stack itself."""

    before: Stack
    after: Stack
    channels: dict[str, Channel]  # of the layers that one of them lacks


class Replaced(NamedTuple):
    """A change to another stack and texture."""

    before: Stacked
    after: Stacked


class Layers(Painter):
    """A painting session with layers above the texture, each with a name, opacity, blend mode and mask.

    Strokes and fills go into the chosen layer; ``None`` is the texture itself, the bottom. ``blend="erase"``
    removes coverage from a layer, and restores the bottom as it was opened. ``texture()`` is the composite.
    Undo and redo cover strokes and changes of the stack. A stroke composites only the tiles that it touches,
    so it takes the same time in all layers.

    All layers have the cells of one tree: fine paint in one makes all of them finer there. That changes them
    by rounding, and a little next to that paint.

    A saved texture whose composite was edited since raises ArgumentError, unless ``keep`` names the part to
    go on with: "shown", the edited composite, or "layers", without the edit.
    """

    def __init__(self, texture: OctreeTexture, surface: Surface, *, keep: Keep | None = None) -> None:
        texture, stack = from_file(as_texture(texture), keep)
        super().__init__(texture, surface)
        self._stack: Stack = stack
        self._last = max((layer.number for layer in stack), default=0)  # number of a layer
        self._chosen: int | None = None
        self._in_mask = False
        self._merging = self._merged
        bottom = {name: texture.channels[name] for name in bottom_names(texture)}
        self._opened = texture.with_cells(texture.tree, bottom) if stack else texture
        self._shown: tuple[OctreeTexture | None, OctreeTexture] = None, texture  # of which, and the composite
        self.changes: tuple[Change, ...] = ()

    def texture(self) -> OctreeTexture:
        """Return the composite as it is now. Textures are immutable: later strokes do not change it."""
        texture = super().texture()
        if self._shown[0] is not texture:
            self._shown = texture, shown(texture, shown_names(texture)) if self._stack else texture
        return self._shown[1]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the texture with all layers to a file; programs without layers show the composite.

        ``Layers(octex.open(path), surface)`` goes on with them. Raises OutputError.
        """
        as_file(self._texture, self._stack).save(path)

    @property
    def layers(self) -> Stack:
        """The layers above the texture, from the lowest to the highest."""
        return self._stack

    @property
    def stacked(self) -> Stacked:
        """The stack as it is now, for ``octex.painting.composites``; later strokes do not change it."""
        return Stacked(super().texture(), self._stack, self._opened)

    @property
    def chosen(self) -> int | None:
        """The number of the chosen layer; None is the texture itself."""
        return self._chosen

    def choose(self, layer: int | None, *, mask: bool = False) -> None:
        """Choose the layer to paint, or its mask: paint of any colour shows, "erase" hides.

        Raises ArgumentError for an unknown layer, and for the mask of the bottom.
        """
        as_flag(mask, "mask")
        if layer is not None:
            self.layer(layer)
        elif mask:
            raise ArgumentError("the texture itself has no mask; choose a layer")
        self._chosen, self._in_mask = layer, mask

    def layer(self, number: int) -> Layer:
        """Return the layer of a number, or raise ArgumentError."""
        return self._stack[self._place_of(number)]

    def add_layer(
        self, name: str | None = None, *, opacity: float = 1.0, blend: LayerBlend = "over"
    ) -> Layer:
        """Add an empty layer above the chosen one; choose and return it."""
        title = f"Layer {self._last + 1}" if name is None else name
        layer = check_layer(self._next(Layer(1, title, opacity, blend)))
        place = 0 if self._chosen is None else self._place_of(self._chosen) + 1
        self._restack((*self._stack[:place], layer, *self._stack[place:]))
        self.choose(layer.number)
        return layer

    def change_layer(
        self,
        number: int,
        *,
        name: str | None = None,
        opacity: float | None = None,
        blend: LayerBlend | None = None,
        is_visible: bool | None = None,
        has_mask: bool | None = None,
    ) -> Layer:
        """Change properties of a layer, and return it."""
        given = {"name": name, "opacity": opacity, "blend": blend}
        given |= {"is_visible": is_visible, "has_mask": has_mask}
        wanted = {key: value for key, value in given.items() if value is not None}
        place = self._place_of(number)
        layer = check_layer(self._stack[place]._replace(**wanted))  # type: ignore[arg-type]
        self._restack((*self._stack[:place], layer, *self._stack[place + 1 :]))
        return layer

    def move_layer(self, number: int, place: int) -> None:
        """Move a layer to a place in the stack; 0 is the lowest."""
        as_whole(place, "place", 0, len(self._stack) - 1)
        layer = self.layer(number)
        others = [each for each in self._stack if each is not layer]
        self._restack((*others[:place], layer, *others[place:]))

    def delete_layer(self, number: int) -> None:
        """Delete a layer with its paint. If it was chosen, the one below becomes so."""
        place = self._place_of(number)
        self._restack(self._stack[:place] + self._stack[place + 1 :])

    def copy_layer(self, number: int) -> Layer:
        """Add a copy of a layer above it; choose and return the copy."""
        place = self._place_of(number)
        layer = self._stack[place]
        copied = self._next(layer)
        channels = {name: each for name, each in self._texture.channels.items() if layer.owns(name)}
        made = {copied.of_own(layer, name): each for name, each in channels.items()}
        self._restack((*self._stack[: place + 1], copied, *self._stack[place + 1 :]), made)
        self.choose(copied.number)
        return copied

    def merge_layer(self, number: int) -> Layer:
        """Merge a layer with the one below it, both visible and normal; choose and return the result.

        It looks as both did. Raises ArgumentError for the lowest layer, and for layers that cannot be merged.
        """
        place = self._place_of(number)
        if not place:
            raise ArgumentError("there is no layer below the lowest one to merge it with")
        both = self._stack[place - 1 : place + 1]
        for each in both:
            if not each.is_visible or each.blend != "over":
                raise ArgumentError(f"layer {each.name!r} is hidden or not normal; only others can be merged")
            if each.paints(ALPHA.name) in self._texture.channels:
                raise ArgumentError(f"layer {each.name!r} paints alpha; it cannot be merged")
        one = self._next(both[0]._replace(opacity=1.0, has_mask=False))
        stack = *self._stack[: place - 1], one, *self._stack[place + 1 :]
        self._restack(stack, united(self._texture, both, one))
        self.choose(one.number)
        return one

    def replace(self, texture: OctreeTexture) -> None:
        """Replace the texture and all layers, as a step that can be undone.

        Raises ArgumentError for a texture of another model, or of parts moved apart otherwise.
        """
        texture, stack = from_file(as_texture(texture))
        if texture.metadata.get(SEPARATION) != self._texture.metadata.get(SEPARATION):
            raise ArgumentError("the model's parts are moved apart in another way")
        check_inside(self._painted.surface, texture.placement)
        bottom = {name: texture.channels[name] for name in bottom_names(texture)}
        self._last = max((self._last, *(layer.number for layer in stack)))
        step = Replaced(self.stacked, Stacked(texture, stack, texture.with_cells(texture.tree, bottom)))
        self._apply_whole(step)
        self._done.append(step)
        self._undone.clear()

    def _apply_whole(self, step: Replaced) -> None:
        seen = self.texture()
        self._texture, self._stack, self._opened = step.after
        self._shared = self._texture
        if self._chosen not in {layer.number for layer in self._stack}:
            self._chosen, self._in_mask = None, False
        self.changes = (Change(None, seen, self.texture()),)

    def _next(self, layer: Layer) -> Layer:
        self._last += 1
        return layer._replace(number=self._last)

    def _place_of(self, number: int) -> int:
        number = as_whole(number, "layer", 1, 2**53)
        for place, layer in enumerate(self._stack):
            if layer.number == number:
                return place
        raise ArgumentError(f"there is no layer {number!r}")

    def _restack(self, stack: Stack, made: Mapping[str, Channel] = MappingProxyType({})) -> None:
        """Replace the stack, as a step that can be undone; ``made`` are the channels of new layers."""
        if stack == self._stack:
            self.changes = ()
            return
        gone = _without(self._stack, stack)
        removed = {name: each for name, each in self._texture.channels.items() if _is_of(gone, name)}
        step = Restacked(self._stack, stack, {**removed, **made})
        self._apply(step)
        self._done.append(step)
        self._undone.clear()

    def _apply(self, step: Restacked) -> None:
        """Apply a step to the stack and its texture."""
        seen, gone = self.texture(), _without(step.before, step.after)
        channels = {name: each for name, each in self._texture.channels.items() if not _is_of(gone, name)}
        come = _without(step.after, step.before)
        channels |= {  # copied, as later strokes write to them and the step stays as it is
            name: each.copied().named(name) for name, each in step.channels.items() if _is_of(come, name)
        }
        if self._chosen in {layer.number for layer in gone}:
            below = step.before[: step.before.index(gone[0])]
            self._chosen, self._in_mask = below[-1].number if below else None, False
        before, after = ([each._replace(name="") for each in stack] for stack in step[:2])
        self._stack, self.changes = step.after, ()
        if before == after:
            return
        self._texture = with_composite(self._texture.with_cells(self._texture.tree, channels), self._stack)
        change = change_of_values(seen, self.texture())
        if change is None:
            self._shown = self._texture, seen
        else:
            self.changes = (change,)

    def _merged(
        self, job: Job, texture: OctreeTexture, paint: OctreeTexture, opacity: float, blend: Blend
    ) -> Change | None:
        """Merge paint into the chosen layer; return the change of all channels, with the composite."""
        into = None
        is_restoring = self._chosen is None and blend == "erase"
        if is_restoring:
            into, blend = ERASED, "over"
            texture = with_layer_channels(texture, [into])
        elif self._chosen is not None:
            layer = self.layer(self._chosen)
            into = layer.paints(painted_channel(paint))
            if self._in_mask:
                into, blend = layer.mask, "over" if blend == "erase" else "erase"
            texture = with_layer_channels(texture, [into, alpha_of(into) or into])
            names = composited(texture, self._stack)
            texture = with_layer_channels(texture, map(composite_name, names))
        change = merged(job, texture, paint, opacity, blend, into)
        if change is None:
            return None
        tiles, before, after = change
        if is_restoring:
            erased, (before, after) = after.channels[ERASED], map(without_erased, (before, after))
            after = restored(after, self._opened, erased)
        first = 0 if tiles is None else int(after.tree.arrays.level_cells[tiles.level + 1])
        after = with_composite(after, self._stack, first)
        change = Change(tiles, before, after)
        if not self._stack or not change.has_same_cells:
            return change
        chosen = {*shown_names(after).values()}
        for name, channel in after.channels.items():
            pairs = zip(before.channels[name][1:], channel[1:], strict=True)
            chosen |= {name} if any(was is not now for was, now in pairs) else set()
        chosen |= {alpha_of(name) or name for name in chosen if name != plain_name(name)}
        drafts = (
            each.with_cells(each.tree, {name: c for name, c in each.channels.items() if name in chosen})
            for each in (before, after)
        )
        return Change(tiles, *drafts)

    def _put(self, change: Change, texture: OctreeTexture) -> OctreeTexture:
        names = change.after.channels.keys()
        if ALPHA.name in names and ALPHA.name not in texture.channels:
            texture = with_alpha(texture)
        texture = with_layer_channels(texture, names)
        if not change.has_same_cells:
            return super()._put(change, texture)
        part = texture.with_cells(texture.tree, {name: texture.channels[name] for name in names})
        made = super()._put(change, part)
        made = made.with_cells(made.tree, {**texture.channels, **made.channels})
        if change.tiles is None:
            self._shared = made
        return made

    def _did(self, changes: Sequence[Change | None]) -> Stroke:
        return self._told(super()._did(changes))

    def _told(self, changes: Sequence[Change]) -> Stroke:
        """Store and return changes as those of the composite."""
        names = dict.fromkeys((*bottom_names(self._texture), ALPHA.name))  # undone, alpha may be gone

        def seen(draft: OctreeTexture) -> OctreeTexture:
            stored = {
                name: [each for each in (composite_name(name), name) if each in draft.channels]
                for name in names
            }
            return shown(draft, {name: found[0] for name, found in stored.items() if found})

        self.changes = tuple(Change(tiles, *map(seen, drafts)) for tiles, *drafts in changes)
        return self.changes

    def put(self, change: Change) -> Stroke:
        """Apply a change that adds channels to the texture; return it. Raises ArgumentError for others."""
        before, after = (each.channels for each in as_change(change)[1:])
        if change.tiles is not None or not before.keys() < after.keys():
            raise ArgumentError("with layers only changes that add channels can be put in")
        channels = {**self._texture.channels, **{name: after[name] for name in after if name not in before}}
        return super().put(
            Change(None, self._texture, self._texture.with_cells(self._texture.tree, channels))
        )

    def covered(self, *, erases: bool) -> list[str] | None:
        """Return the channels whose coverage an eraser or a mask paints; None for other paint."""
        if not (as_flag(erases, "erases") or self._in_mask):
            return None
        if self._chosen is None or self._in_mask:
            return [BASE_COLOR.name]
        return self.layer(self._chosen).painted(self._texture.channels) or [BASE_COLOR.name]

    def _moved(self, source: History, target: History) -> bool:
        self.changes = ()
        step, undoes = source.last, source is self._done
        if isinstance(step, Replaced):
            self._apply_whole(Replaced(step.after, step.before) if undoes else step)
            target.append(source.pop())
            return True
        if not isinstance(step, Restacked):
            was_moved = super()._moved(source, target)
            self._told([change.inverted() for change in reversed(step)] if undoes else step)
            return was_moved
        self._apply(Restacked(step.after, step.before, step.channels) if undoes else step)
        target.append(source.pop())
        return True


def _without(stack: Stack, other: Stack) -> list[Layer]:
    """Return the layers of a stack that another one lacks."""
    numbers = {layer.number for layer in other}
    return [layer for layer in stack if layer.number not in numbers]


def _is_of(layers: Sequence[Layer], name: str) -> bool:
    return any(layer.owns(name) for layer in layers)
