"""Work that only several photographs need, before painting begins.

Input: photographs and cameras. Output: masks, gains and weights of each photograph, or better cameras.

    misfits       finds photographs that cannot be right
    balance       gains, white balance, vignetting; masks where a photograph is clipped
    agreement     masks where only one of at least three photographs shows a thing
    sharpness     blurred photographs weigh less
    labels        chooses one photograph for each patch of the surface
    weigh         applies all of these to one source of paint
    refine        turns, moves and zooms cameras until their photographs agree
"""
