"""What only several photographs need, before painting begins.

Photographs and cameras go in; masks, gains and weights of each picture come out, or cameras that fit better.

    balance       gains, white balance and vignetting by which pictures agree
    overexposed   masks where a picture is clipped and another one is not
    agreement     masks where only one of at least three pictures shows a thing
    sharpness     blurred pictures weigh less
    best          one picture for each part of the surface; `labels` chooses them
    refine        cameras turned, moved and zoomed a little until their pictures agree
"""
