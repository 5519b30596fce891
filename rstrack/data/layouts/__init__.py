"""The layouts of folders that can be tracked: TUM RGB-D and ICL-NUIM, 7-Scenes, rsgen's own."""
