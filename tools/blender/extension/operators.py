# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands: each starts work in another process and takes over what comes of it."""

from pathlib import Path
from typing import Any

import bpy
import numpy as np

from . import exact, handover, objects, watching
from .jobs import Job, JobError

#: Seconds between looks at a job: the window never waits longer.
_PAUSE = 0.05


class Working:
    """An operator that begins a job, shows its progress, and finishes with its answer.

    ``invoke`` leaves Blender usable meanwhile, and Esc cancels; ``execute``, as scripts call it, waits.
    """

    bl_options = {"REGISTER", "UNDO"}
    running: "Working | None" = None

    def begin(self, context: bpy.types.Context, chosen: bpy.types.Object) -> Job:
        """Return the job of the active object; raises ObjectError."""
        raise NotImplementedError

    def finish(self, context: bpy.types.Context, answer: dict[str, Any]) -> str:
        """Take over what the job has made, and return what to tell; raises ObjectError."""
        raise NotImplementedError

    def chosen(self) -> bpy.types.Object:
        """Return the object that the job is of; raises ObjectError if it is gone."""
        found = objects.found(self.target, self.uid)
        if found is None:
            raise objects.ObjectError(f"{self.target} is gone; nothing was changed")
        return found

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if Working.running is not None:
            cls.poll_message_set("octex is at work")
            return False
        return context.active_object is not None and context.active_object.type == "MESH"

    def _begun(self, context: bpy.types.Context) -> bool:
        """Start the job, or report why there is none."""
        try:
            chosen = objects.mesh_object(context)
            self.target, self.uid = chosen.name, chosen.session_uid
            self.job = self.begin(context, chosen)
        except objects.ObjectError as error:
            self.report({"ERROR"}, str(error))
            return False
        self.job.start()
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        if not self._begun(context):
            return {"CANCELLED"}
        try:
            return self._finished(context, self.job.wait())
        except (JobError, objects.ObjectError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        finally:
            self.job.close()

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if not self._begun(context):
            return {"CANCELLED"}
        self._timer = context.window_manager.event_timer_add(_PAUSE, window=context.window)
        context.window_manager.modal_handler_add(self)
        Working.running = self
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC":
            self.cancel(context)
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        shown = self.job.stage, self.job.share
        result = {"CANCELLED"}
        try:
            answer = self.job.poll()
            result = {"PASS_THROUGH"} if answer is None else self._finished(context, answer)
        except (JobError, objects.ObjectError) as error:
            self.report({"ERROR"}, str(error))
        finally:
            if result != {"PASS_THROUGH"}:
                self.cancel(context)
            elif shown != (self.job.stage, self.job.share):
                watching.redraw()
        return result

    def cancel(self, context: bpy.types.Context) -> None:
        """End the job: it is over, or Blender opens another file or closes."""
        Working.running = None
        context.window_manager.event_timer_remove(self._timer)
        watching.redraw()
        self.job.close()

    def _finished(self, context: bpy.types.Context, answer: dict[str, Any]) -> set[str]:
        for warning in self.job.warnings:
            self.report({"WARNING"}, warning)
        try:
            self.report({"INFO"}, self.finish(context, answer))
        except objects.ObjectError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class OCTEX_OT_make(Working, bpy.types.Operator):
    """Make an octree texture of the active object: of its materials, or grey"""

    bl_idname = "octex.make"
    bl_label = "Make Octree Texture"

    def begin(self, _context: bpy.types.Context, chosen: bpy.types.Object) -> Job:
        output, settings = objects.texture_path(chosen, exists=False), chosen.octex
        is_grey = settings.origin == "GREY"
        for name in objects.making_modifiers(chosen):
            self.report({"WARNING"}, f"{name} makes geometry that the texture does not know; apply it first")
        for complaint in () if is_grey else objects.check_images(chosen):
            self.report({"WARNING"}, complaint)
        given = {"depth": settings.depth, "origin": settings.origin, "output": str(output)}
        return job_of("make", chosen, "arrays" if is_grey else "model", **given)

    def finish(self, _context: bpy.types.Context, answer: dict[str, Any]) -> str:
        channels = ", ".join(answer["channels"])
        return f"{objects.texture_path(self.chosen()).name}: {answer['cells']:,} cells of {channels}"


class OCTEX_OT_colors(Working, bpy.types.Operator):
    """Bake the texture into a colour attribute at the corners of faces, and show it"""

    bl_idname = "octex.colors"
    bl_label = "Bake to Colour Attribute"

    def begin(self, _context: bpy.types.Context, chosen: bpy.types.Object) -> Job:
        if chosen.data.users > 1:
            said = f"{chosen.data.users} objects share the mesh {chosen.data.name}, and these colours with it"
            self.report({"WARNING"}, said)
        return colors_job(chosen)

    def finish(self, _context: bpy.types.Context, _answer: dict[str, Any]) -> str:
        take_colors(self.chosen(), self.job)
        objects.show(self.chosen())
        return f"{self.target} shows the colour attribute {objects.NAME}"


class OCTEX_OT_images(Working, bpy.types.Operator):
    """Bake the texture to images at the object's UVs or at new ones, and show them"""

    bl_idname = "octex.images"
    bl_label = "Bake to Images"

    def begin(self, _context: bpy.types.Context, chosen: bpy.types.Object) -> Job:
        objects.check_editable(chosen)
        settings, texture = chosen.octex, str(objects.texture_path(chosen))
        shown, pixels = handover.baked_images(chosen)
        if settings.layout == "KEEP" and not chosen.data.uv_layers:
            raise objects.ObjectError(f"{chosen.name} has no UV map; choose new UVs")
        form = "arrays" if settings.layout == "ATLAS" else "without images"
        given = {"texture_size": settings.texture_size, "layout": settings.layout, "shown": shown}
        return job_of("images", chosen, form, texture=texture, output=texture, **given).reading(pixels)

    def finish(self, _context: bpy.types.Context, answer: dict[str, Any]) -> str:
        chosen = self.chosen()
        if (self.job.folder / "uv.npy").exists():
            objects.set_uv(chosen, self.job.array("uv"))
        for each in answer["materials"]:
            each["maps"] = {name: _image(path, name) for name, path in each["maps"].items()}
        objects.show(chosen, answer["materials"])
        count = sum(len(each["maps"]) for each in answer["materials"])
        return f"Wrote {count} images to {objects.texture_path(chosen).parent}"


class OCTEX_OT_exact(Working, bpy.types.Operator):
    """Have Cycles look the texture up at each point, by an OSL node: nothing is baked"""

    bl_idname = "octex.exact"
    bl_label = "Exact in Cycles"

    def begin(self, context: bpy.types.Context, chosen: bpy.types.Object) -> Job:
        exact.check_osl(context)
        objects.check_editable(chosen)
        texture = objects.texture_path(chosen)
        return job_of("exact", chosen, texture=str(texture), output=str(texture.with_suffix(".osl")))

    def finish(self, context: bpy.types.Context, answer: dict[str, Any]) -> str:
        chosen, rest = self.chosen(), None
        if chosen.modifiers or chosen.data.shape_keys:
            rest = self.job.array("rest"), self.job.array("normals")
        exact.show(context, chosen, Path(answer["shader"]), answer["outputs"], rest)
        if context.scene.render.engine != "CYCLES":
            self.report({"WARNING"}, "Choose Cycles as the render engine: no other has the OSL node")
        return f"Cycles reads {Path(answer['shader']).name}.tif"


class OCTEX_OT_photographs(Working, bpy.types.Operator):
    """Project the cameras' background images, and a COLMAP folder's, into the texture or a new one"""

    bl_idname = "octex.photographs"
    bl_label = "Project Photographs"

    def begin(self, context: bpy.types.Context, chosen: bpy.types.Object) -> Job:
        output = objects.texture_path(chosen, exists=False)
        cameras = bpy.path.abspath(chosen.octex.cameras) if chosen.octex.cameras else ""
        images, reads = handover.photographs(context, not cameras)
        return job_of(
            "photographs", chosen, posed=objects.posed_positions(context, chosen),
            depth=chosen.octex.depth, output=str(output), texture=str(output) if output.exists() else "",
            photographs=images, cameras=cameras,
            mirrored=chosen.matrix_world.determinant() < 0,  # its front then faces inwards
        ).reading(reads)  # fmt: skip

    def finish(self, _context: bpy.types.Context, answer: dict[str, Any]) -> str:
        return f"{objects.texture_path(self.chosen()).name}: {answer['cells']:,} cells"


class OCTEX_OT_view(Working, bpy.types.Operator):
    """Draw the texture as the 3D view or the scene's camera sees it, to be painted on and projected"""

    bl_idname = "octex.view"
    bl_label = "Draw View to Paint"

    def begin(self, context: bpy.types.Context, chosen: bpy.types.Object) -> Job:
        texture = objects.texture_path(chosen)
        camera = objects.view_camera(context)
        self.camera, self.view = camera.name, (camera.matrix_world.copy(), camera.data.lens)
        render = context.scene.render
        size = [
            max(each * render.resolution_percentage // 100, 1)
            for each in (render.resolution_x, render.resolution_y)
        ]
        output = texture.with_name(f"{texture.stem}-{bpy.path.clean_name(camera.name)}.png")
        lens = objects.lens_and_pose(camera)
        if not camera.users_scene:  # the scene gets it when the job is done
            bpy.data.cameras.remove(camera.data)
        given = {"texture": str(texture), "output": str(output), "size": size, "camera": lens}
        return job_of("view", chosen, posed=objects.posed_positions(context, chosen), **given)

    def finish(self, context: bpy.types.Context, answer: dict[str, Any]) -> str:
        output = Path(answer["output"])
        if not answer["pixels"]:
            raise objects.ObjectError(f"{self.camera} does not see {self.target}")
        camera = bpy.data.objects.get(self.camera) or objects.new_camera(*self.view)
        if not camera.users_scene:
            context.scene.collection.objects.link(camera)
        objects.set_view(camera, output)
        return f"Paint on {output.name}, then project photographs"


class OCTEX_OT_strokes(Working, bpy.types.Operator):
    """Take over what was painted on the baked images, as in Texture Paint, into the octree texture"""

    bl_idname = "octex.strokes"
    bl_label = "Take Over Image Paint"

    def begin(self, _context: bpy.types.Context, chosen: bpy.types.Object) -> Job:
        texture = objects.texture_path(chosen)
        shown = [each.material for each in chosen.material_slots if each.material is not None]
        images = {each.name: each[objects.BAKED] for each in shown if each.get(objects.BAKED)}
        if not images:
            raise objects.ObjectError(f"{chosen.name} shows no baked images: bake to images first")
        objects.check_images(chosen, shown=True)
        return job_of("strokes", chosen, "shown", texture=str(texture), images=images)

    def finish(self, _context: bpy.types.Context, answer: dict[str, Any]) -> str:
        return f"{objects.texture_path(self.chosen()).name} has {answer['texels']:,} painted texels"


class OCTEX_OT_paint(bpy.types.Operator):
    """Paint in the browser, which saves a new texture next to this one; the object then shows that"""

    bl_idname = "octex.paint"
    bl_label = "Paint in Browser"

    poll = classmethod(Working.poll.__func__)  # of this class: it says why it refuses

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            output = watching.paint(objects.mesh_object(context))
        except objects.ObjectError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"The browser opens; Ctrl-S there saves {output.name}")
        return {"FINISHED"}


def _image(path: str, channel: str) -> bpy.types.Image:
    image = objects.loaded(Path(path))
    image.colorspace_settings.name = "sRGB" if channel in ("base_color", "emissive") else "Non-Color"
    return image


def job_of(
    task: str, chosen: bpy.types.Object, form: str = "arrays", posed: np.ndarray | None = None, **given: Any
) -> Job:
    """Return a job that begins with an object in a form, and where its vertices are seen: see `hand_over`."""
    job = Job(task, name=chosen.name, **given)
    handover.hand_over(chosen, job, form)
    if posed is not None:
        np.save(job.folder / "posed.npy", posed)
        job.fields["matrix"] = [list(row) for row in chosen.matrix_world]
    return job


def colors_job(chosen: bpy.types.Object) -> Job:
    """Return the job that looks up an object's colours; raises ObjectError."""
    objects.check_editable(chosen)
    return job_of("colors", chosen, texture=str(objects.texture_path(chosen)))


def take_colors(chosen: bpy.types.Object, job: Job) -> None:
    """Store the colours of a job that has ended."""
    objects.set_colors(chosen, job.array("colors"))


register, _unregister = bpy.utils.register_classes_factory([*Working.__subclasses__(), OCTEX_OT_paint])


def unregister() -> None:
    if Working.running is not None:
        Working.running.job.close()
        Working.running = None
    _unregister()
