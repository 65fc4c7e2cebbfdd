"""What images show between two times: the points and the road in both of them, and the geometry that fits.

In the order of the work:
    images       grey images of one size, their texture, their features and matches; the road in two of them: how
                 much its tiles look alike, and points by optical flow
    residuals    how far matched points and points of the road are from where a geometry puts them, and robust least
                 squares over groups of such residuals, with standard deviations

A group is two images: of one camera at two times, or of two neighbours. Its geometry is where the cameras were and how
the vehicle moved.
"""
