"""Images and ground truth maps of the world.

ground_texture   the painted ground as a texture
shadow_map       where objects block the sun
rasteriser       which triangle each pixel sees, with raster_kernels
shading          the colour of each pixel, with shading_kernels
lens             images of cameras with distortion
renderer         all of these together: the image of one camera
bev_map          the ground truth map
"""
