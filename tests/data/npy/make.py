"""Makes the .npy files of this folder: python3 make.py (needs NumPy).

In the files that hold a density, element [x, y, z] of the 4 × 5 × 6 array is (x + 10 y + 100 z) / 8, exact in half precision.
"""

import numpy as np

x, y, z = np.meshgrid(np.arange(4), np.arange(5), np.arange(6), indexing="ij")
ramp = (x + 10 * y + 100 * z) / 8

np.save("f2.npy", ramp.astype("<f2"))
np.save("f4.npy", ramp.astype("<f4"))
np.save("f8.npy", ramp.astype("<f8"))
np.save("f4_big_endian.npy", ramp.astype(">f4"))
np.save("f4_fortran.npy", np.asfortranarray(ramp.astype("<f4")))
np.save("f8_big_endian_fortran.npy", np.asfortranarray(ramp.astype(">f8")))
with open("f4_version3.npy", "wb") as file:
    np.lib.format.write_array(file, ramp.astype("<f4"), version=(3, 0))

np.save("int.npy", ramp.astype("<i4"))
np.save("bool.npy", ramp > 1)
np.save("complex.npy", ramp.astype("<c8"))
np.save("record.npy", np.zeros((2, 2, 2), dtype=[("density", "<f4"), ("heat", "<f4")]))
np.save("flat.npy", ramp[0].astype("<f4"))
np.save("empty.npy", np.zeros((2, 0, 2), "<f4"))

odd = ramp.astype("<f4")
odd[1, 2, 3] = -1
np.save("negative.npy", odd)
odd[2, 3, 4] = np.inf
np.save("infinite.npy", odd)
