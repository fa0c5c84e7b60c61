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
    only,
    shown,
    shown_names,
    united,
    with_channels,
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
        self._opened = only(texture, bottom_names(texture))
        self._last = max((layer.number for layer in stack), default=0)  # number of a layer
        self._chosen: int | None = None
        self._in_mask = False
        self._merging = self._merged
        # A texture with all layers, and its composite.
        self._shown: tuple[OctreeTexture | None, OctreeTexture] = None, texture
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
        return self._stack[self._index_of(number)]

    def add_layer(
        self, name: str | None = None, *, opacity: float = 1.0, blend: LayerBlend = "over"
    ) -> Layer:
        """Add an empty layer above the chosen one; choose and return it."""
        title = f"Layer {self._last + 1}" if name is None else name
        layer = check_layer(self._next(Layer(1, title, opacity, blend)))
        above = 0 if self._chosen is None else self._index_of(self._chosen) + 1
        self._restack(self._with_layers(above, above, layer))
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
        properties = {"name": name, "opacity": opacity, "blend": blend}
        properties |= {"is_visible": is_visible, "has_mask": has_mask}
        changed = {key: value for key, value in properties.items() if value is not None}
        index = self._index_of(number)
        layer = check_layer(self._stack[index]._replace(**changed))  # type: ignore[arg-type]
        self._restack(self._with_layers(index, index + 1, layer))
        return layer

    def move_layer(self, number: int, place: int) -> None:
        """Move a layer to a place in the stack; 0 is the lowest."""
        as_whole(place, "place", 0, len(self._stack) - 1)
        layer = self.layer(number)
        rest = [each for each in self._stack if each is not layer]
        self._restack((*rest[:place], layer, *rest[place:]))

    def delete_layer(self, number: int) -> None:
        """Delete a layer with its paint. If it was chosen, the one below becomes so."""
        index = self._index_of(number)
        self._restack(self._with_layers(index, index + 1))

    def copy_layer(self, number: int) -> Layer:
        """Add a copy of a layer above it; choose and return the copy."""
        above = self._index_of(number) + 1
        layer = self._stack[above - 1]
        copied = self._next(layer)
        channels = {name: each for name, each in self._texture.channels.items() if layer.owns(name)}
        copies = {copied.of_own(layer, name): each for name, each in channels.items()}
        self._restack(self._with_layers(above, above, copied), copies)
        self.choose(copied.number)
        return copied

    def merge_layer(self, number: int) -> Layer:
        """Merge a layer with the one below it, both visible and normal; choose and return the result.

        It looks as both did. Raises ArgumentError for the lowest layer, and for layers that cannot be merged.
        """
        index = self._index_of(number)
        if not index:
            raise ArgumentError("there is no layer below the lowest one to merge it with")
        pair = self._stack[index - 1 : index + 1]
        for layer in pair:
            if not layer.is_visible or layer.blend != "over":
                raise ArgumentError(
                    f"layer {layer.name!r} is hidden or not normal; only others can be merged"
                )
            if layer.paints(ALPHA.name) in self._texture.channels:
                raise ArgumentError(f"layer {layer.name!r} paints alpha; it cannot be merged")
        union = self._next(pair[0]._replace(opacity=1.0, has_mask=False))
        self._restack(self._with_layers(index - 1, index + 1, union), united(self._texture, pair, union))
        self.choose(union.number)
        return union

    def replace(self, texture: OctreeTexture) -> None:
        """Replace the texture and all layers, as a step that can be undone.

        Raises ArgumentError for a texture of another model, or of parts moved apart otherwise.
        """
        texture, stack = from_file(as_texture(texture))
        if texture.metadata.get(SEPARATION) != self._texture.metadata.get(SEPARATION):
            raise ArgumentError("the model's parts are moved apart in another way")
        check_inside(self._painted.surface, texture.placement)
        self._last = max((self._last, *(layer.number for layer in stack)))
        step = Replaced(self.stacked, Stacked(texture, stack, only(texture, bottom_names(texture))))
        self._apply_whole(step)
        self._done.append(step)
        self._undone.clear()

    def _apply_whole(self, step: Replaced) -> None:
        before = self.texture()
        self._texture, self._stack, self._opened = step.after
        self._shared = self._texture
        if self._chosen not in {layer.number for layer in self._stack}:
            self._chosen, self._in_mask = None, False
        self.changes = (Change(None, before, self.texture()),)

    def _next(self, layer: Layer) -> Layer:
        self._last += 1
        return layer._replace(number=self._last)

    def _index_of(self, number: int) -> int:
        number = as_whole(number, "layer", 1, 2**53)
        for index, layer in enumerate(self._stack):
            if layer.number == number:
                return index
        raise ArgumentError(f"there is no layer {number!r}")

    def _with_layers(self, begin: int, end: int, *layers: Layer) -> Stack:
        """Return the stack with other layers instead of those from ``begin`` to ``end``."""
        return *self._stack[:begin], *layers, *self._stack[end:]

    def _restack(self, stack: Stack, added: Mapping[str, Channel] = MappingProxyType({})) -> None:
        """Replace the stack, as a step that can be undone; ``added`` are the channels of new layers."""
        if stack == self._stack:
            self.changes = ()
            return
        gone = _without(self._stack, stack)
        removed = {name: each for name, each in self._texture.channels.items() if _is_of(gone, name)}
        step = Restacked(self._stack, stack, {**removed, **added})
        self._apply(step)
        self._done.append(step)
        self._undone.clear()

    def _apply(self, step: Restacked) -> None:
        """Apply a step to the stack and its texture."""
        shown_before, gone = self.texture(), _without(step.before, step.after)
        channels = {name: each for name, each in self._texture.channels.items() if not _is_of(gone, name)}
        new = _without(step.after, step.before)
        channels |= {  # copied, as later strokes write to them and the step stays as it is
            name: each.copied().named(name) for name, each in step.channels.items() if _is_of(new, name)
        }
        if self._chosen in {layer.number for layer in gone}:
            below = step.before[: step.before.index(gone[0])]
            self._chosen, self._in_mask = below[-1].number if below else None, False
        before, after = ([each._replace(name="") for each in stack] for stack in step[:2])
        self._stack, self.changes = step.after, ()
        if before == after:
            return
        self._texture = with_composite(with_channels(self._texture, channels), self._stack)
        change = change_of_values(shown_before, self.texture())
        if change is None:
            self._shown = self._texture, shown_before
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
            composites = map(composite_name, composited(texture, self._stack))
            texture = with_layer_channels(texture, composites)
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
        names = {*shown_names(after).values()}
        for name, channel in after.channels.items():
            pairs = zip(before.channels[name][1:], channel[1:], strict=True)
            names |= {name} if any(was is not now for was, now in pairs) else set()
        names |= {alpha_of(name) or name for name in names if name != plain_name(name)}
        return Change(tiles, only(before, names), only(after, names))

    def _put(self, change: Change, texture: OctreeTexture) -> OctreeTexture:
        names = change.after.channels.keys()
        if ALPHA.name in names and ALPHA.name not in texture.channels:
            texture = with_alpha(texture)
        texture = with_layer_channels(texture, names)
        if not change.has_same_cells:
            return super()._put(change, texture)
        changed = super()._put(change, only(texture, names))
        changed = with_channels(changed, {**texture.channels, **changed.channels})
        if change.tiles is None:
            self._shared = changed
        return changed

    def _did(self, changes: Sequence[Change | None]) -> Stroke:
        return self._composite_changes(super()._did(changes))

    def _composite_changes(self, changes: Sequence[Change]) -> Stroke:
        """Store and return changes as those of the composite."""
        names = dict.fromkeys((*bottom_names(self._texture), ALPHA.name))  # undone, alpha may be gone

        def composite(draft: OctreeTexture) -> OctreeTexture:
            stored = {
                name: composite_name(name) if composite_name(name) in draft.channels else name
                for name in names
            }
            return shown(draft, {name: each for name, each in stored.items() if each in draft.channels})

        self.changes = tuple(Change(tiles, *map(composite, drafts)) for tiles, *drafts in changes)
        return self.changes

    def put(self, change: Change) -> Stroke:
        """Apply a change that adds channels to the texture; return it. Raises ArgumentError for others."""
        before, after = (each.channels for each in as_change(change)[1:])
        if change.tiles is not None or not before.keys() < after.keys():
            raise ArgumentError("with layers only changes that add channels can be put in")
        channels = {**self._texture.channels, **{name: after[name] for name in after if name not in before}}
        return super().put(Change(None, self._texture, with_channels(self._texture, channels)))

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
            self._composite_changes([change.inverted() for change in reversed(step)] if undoes else step)
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
