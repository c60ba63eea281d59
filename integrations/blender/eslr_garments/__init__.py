# SPDX-License-Identifier: GPL-3.0-or-later
"""Simulate a garment on an animated character with eslr_jax, which runs in a process of its own."""

import shutil
import tempfile
import time
from pathlib import Path
from typing import ClassVar

import bpy

from . import exchange
from .exchange import ExchangeError
from .job import Job, JobError, simulation_steps

_INTERVAL = 0.25  # [s] between looks at the process


class GarmentPreferences(bpy.types.AddonPreferences):
    """Where the simulator is."""

    bl_idname = __package__

    python: bpy.props.StringProperty(
        name="Python",
        description="Path of the Python that has eslr_jax (pip install . in its folder)",
        default="python3",
        subtype="FILE_PATH",
    )

    def draw(self, context):
        """Show the path."""
        self.layout.prop(self, "python")


class GarmentSettings(bpy.types.PropertyGroup):
    """What to simulate; kept in the scene."""

    garment: bpy.props.PointerProperty(
        name="Garment",
        description="Mesh of the garment, on the body in its rest pose",
        type=bpy.types.Object,
        poll=lambda self, thing: thing.type == "MESH",
    )
    body: bpy.props.PointerProperty(
        name="Body",
        description="Mesh of the body, deformed by an armature that moves",
        type=bpy.types.Object,
        poll=lambda self, thing: thing.type == "MESH" and thing.find_armature() is not None,
    )
    fabric: bpy.props.StringProperty(
        name="Fabric", description="As for eslr simulate --fabric, such as denim or silk", default="cotton"
    )
    tolerance: bpy.props.StringProperty(
        name="Tolerance", description="As for eslr simulate --tolerance: less is more accurate", default="1%"
    )
    self_contact: bpy.props.BoolProperty(
        name="Self-contact",
        description="Let nothing pass through cloth; takes twice as long as to keep its vertices off the body",
        default=True,
    )
    folder: bpy.props.StringProperty(
        name="Cache",
        description="Folder of the point cache; beside the file if it begins with //",
        default="//eslr",
        subtype="DIR_PATH",
    )
    status: bpy.props.StringProperty(options={"SKIP_SAVE"})


class ESLR_OT_simulate(bpy.types.Operator):
    """Simulate the garment over the scene's frames; Esc cancels."""

    bl_idname = "eslr.simulate"
    bl_label = "Simulate garment"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        """Ask for a garment and a body."""
        settings = context.scene.eslr
        return settings.garment is not None and settings.body is not None

    def execute(self, context):
        """Simulate and wait, for scripts and without a window."""
        if not self._begin(context):
            return {"CANCELLED"}
        while (result := self._go_on(context)) is None:
            time.sleep(_INTERVAL)
        return result

    def invoke(self, context, event):
        """Simulate while Blender goes on."""
        if not self._begin(context):
            return {"CANCELLED"}
        manager = context.window_manager
        self._timer = manager.event_timer_add(_INTERVAL, window=context.window)
        manager.progress_begin(0, 100)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        """Look at the process now and then."""
        if event.type == "ESC":
            self._job.cancel()
            self._end(context)
            self.report({"WARNING"}, "cancelled; the garment is as it was")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        result = self._go_on(context)
        if result is not None:
            return result
        context.window_manager.progress_update(100 * self._job.share)
        context.workspace.status_text_set(f"{self._job.text}; Esc cancels")
        for area in context.screen.areas:
            area.tag_redraw()
        return {"RUNNING_MODAL"}

    def _begin(self, context) -> bool:
        """Write what the simulator reads; return whether it can start."""
        settings = context.scene.eslr
        self._timer, self._folder = None, Path(tempfile.mkdtemp(prefix="eslr_"))
        self._name = settings.garment.name  # an undo meanwhile makes another object of it
        python = context.preferences.addons[__package__].preferences.python
        try:
            exchange.export_body(self._folder / "body.glb", settings.body, context)
            exchange.export_garment(self._folder / "garment.obj", settings.garment, context.scene)
        except (ExchangeError, RuntimeError) as error:  # the second is the exporter's
            self.report({"ERROR"}, str(error))
            shutil.rmtree(self._folder, ignore_errors=True)
            return False
        steps = simulation_steps(
            bpy.path.abspath(python), self._folder, settings.fabric, settings.tolerance, settings.self_contact
        )
        self._job, self._is_placed = Job(steps, self._folder), False
        return True

    def _go_on(self, context):
        """Return the operator's result, or None while the simulator runs."""
        settings = context.scene.eslr
        try:
            is_done = self._job.poll()
            settings.status = self._job.text
            if self._job.num_done and not self._is_placed:
                exchange.check_place(self._folder / "fit.txt")
                self._is_placed = True
            if not is_done:
                return None
            garment = bpy.data.objects.get(self._name)
            if garment is None:
                raise ExchangeError(f"{self._name} is gone or has another name; simulate it again")
            positions = exchange.read_motion(self._folder / "motion.npz", garment)
            start = exchange.read_start(self._folder / "run" / "report.json")
            exchange.lay_cache(garment, positions, self._cache_path(settings), context.scene, start=start)
        except (ExchangeError, JobError, OSError, ReferenceError) as error:
            self._job.cancel()
            self._end(context)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self._end(context)
        for text in self._job.warnings:
            self.report({"WARNING"}, text)
        self.report({"INFO"}, f"{self._name} follows {len(positions)} simulated frames")
        return {"FINISHED"}

    def _cache_path(self, settings) -> Path:
        """Return where the point cache belongs; a file that is not saved yet has no place of its own."""
        folder = settings.folder
        if folder.startswith("//") and not bpy.data.filepath:
            self.report(
                {"WARNING"}, "this file is not saved: its cache is temporary, and lost with the next start"
            )
            folder = str(Path(bpy.app.tempdir) / folder.removeprefix("//"))
        return Path(bpy.path.abspath(folder)) / f"{bpy.path.clean_name(self._name)}.pc2"

    def _end(self, context) -> None:
        """Take away what only the run needed."""
        context.scene.eslr.status = ""
        shutil.rmtree(self._folder, ignore_errors=True)
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            context.window_manager.progress_end()
            context.workspace.status_text_set(None)


class VIEW3D_PT_eslr(bpy.types.Panel):
    """The settings and the button."""

    bl_label = "Garment simulation"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Garment"

    def draw(self, context):
        """Show them."""
        settings = context.scene.eslr
        for name in ("garment", "body", "fabric", "tolerance", "self_contact", "folder"):
            self.layout.prop(settings, name)
        self.layout.operator(ESLR_OT_simulate.bl_idname, icon="MOD_CLOTH")
        if settings.status:
            self.layout.label(text=settings.status)


_CLASSES = (GarmentPreferences, GarmentSettings, ESLR_OT_simulate, VIEW3D_PT_eslr)


def register():
    """Add the panel, the operator and the scene's settings."""
    for entry in _CLASSES:
        bpy.utils.register_class(entry)
    bpy.types.Scene.eslr = bpy.props.PointerProperty(type=GarmentSettings)


def unregister():
    """Take them away again."""
    del bpy.types.Scene.eslr
    for entry in reversed(_CLASSES):
        bpy.utils.unregister_class(entry)
