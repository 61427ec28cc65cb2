"""Import of images with known poses: COLMAP, nerfstudio, Blender, LLFF, Polycam, Record3D."""
