"""Furniture libraries of Sweet Home 3D as object folders: free models, some of which open."""

from quest.sim.sweethome.folder import Imported, import_library

__all__ = ["Imported", "import_library"]
