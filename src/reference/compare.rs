//! The error of an image against a reference that may be noisy.

use thiserror::Error;

/// Pixels count where the reference alpha is above this.
pub const SMOKE_ALPHA: f32 = 0.02;

/// How far an image is from the reference, over smoke pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageError {
    /// Root mean square difference over root mean square reference.
    pub relative: f64,
    /// Root mean square difference, in the image's units.
    pub rms: f64,
    /// Smoke pixels counted.
    pub pixels: usize,
}

/// Why two images cannot be compared.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum CompareError {
    /// The images differ in size.
    #[error("{image} has {found} pixels where the alpha image has {expected}: compare images of the same size")]
    Size {
        /// Which image.
        image: &'static str,
        /// Its pixels.
        found: usize,
        /// Pixels of the alpha image.
        expected: usize,
    },
    /// A value is NaN or infinite.
    #[error("{image} is not finite at pixel {pixel} (counted row by row from the top left)")]
    NotFinite {
        /// Which image.
        image: &'static str,
        /// Flat index of the pixel.
        pixel: usize,
    },
    /// There is no smoke to compare.
    #[error("no pixel of the alpha image is above {SMOKE_ALPHA}: there is no smoke to compare")]
    NoSmoke,
    /// There is no light to be relative to.
    #[error("the reference is black, or only noise, over the smoke: a relative error needs a lit reference")]
    Black,
}

/// The error of `x` against `reference` over the pixels whose reference `alpha` is above [`SMOKE_ALPHA`], all `C`
/// channels alike.
///
/// An image with noise comes as two independent halves, and the error is free of that noise on average:
/// mse = max(0, mean (x₁−b₁)(x₂−b₂)), relative to mean b₁b₂. A noise-free one is passed twice.
///
/// # Errors
/// Images of different sizes, values that are not finite in smoke pixels, no smoke, or a black reference.
pub fn image_error<const C: usize>(
    x: [&[[f32; C]]; 2],
    reference: [&[[f32; C]]; 2],
    alpha: &[f32],
) -> Result<ImageError, CompareError> {
    let images = [("image", x[0]), ("image", x[1]), ("reference", reference[0]), ("reference", reference[1])];
    for (image, pixels) in images {
        if pixels.len() != alpha.len() {
            return Err(CompareError::Size { image, found: pixels.len(), expected: alpha.len() });
        }
    }
    let (mut difference, mut power, mut pixels) = (0.0, 0.0, 0);
    for pixel in (0..alpha.len()).filter(|&pixel| alpha[pixel] > SMOKE_ALPHA) {
        for (image, values) in images {
            if !values[pixel].iter().all(|v| v.is_finite()) {
                return Err(CompareError::NotFinite { image, pixel });
            }
        }
        for channel in 0..C {
            let [x1, x2, b1, b2] = images.map(|(_, values)| f64::from(values[pixel][channel]));
            difference += (x1 - b1) * (x2 - b2);
            power += b1 * b2;
        }
        pixels += 1;
    }
    if pixels == 0 {
        return Err(CompareError::NoSmoke);
    }
    if power <= 0.0 {
        return Err(CompareError::Black);
    }
    let difference = difference.max(0.0);
    let rms = (difference / (pixels * C) as f64).sqrt();
    Ok(ImageError { relative: (difference / power).sqrt(), rms, pixels })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_differences() {
        let b = [[1.0f32, 2.0, 2.0], [3.0, 0.0, 4.0], [9.0, 9.0, 9.0]];
        let x = [[1.0f32, 2.0, 5.0], [3.0, 4.0, 4.0], [0.0, 0.0, 0.0]];
        // Squares of the differences: 9 + 16; of the reference: 9 + 25. The third pixel holds no smoke.
        let error = image_error([&x, &x], [&b, &b], &[1.0, 0.021, 0.02]).unwrap();
        assert_eq!(error.pixels, 2);
        assert!((error.relative - (25f64 / 34.0).sqrt()).abs() < 1e-15);
        assert!((error.rms - (25f64 / 6.0).sqrt()).abs() < 1e-15);
        assert_eq!(image_error([&b, &b], [&b, &b], &[1.0; 3]).unwrap().relative, 0.0);
    }

    #[test]
    fn halves_are_unbiased() {
        // Noise of a quarter of the signal; over 40,000 pixels the mean product of two differences of variance 2·0.0625
        // has a standard deviation of 0.125/√40000 = 0.0006.
        let mut state = 1u32;
        let mut noisy = |value: f32| -> Vec<[f32; 1]> {
            (0..40_000)
                .map(|_| {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    [value + (state as f32 / u32::MAX as f32 - 0.5) * 12f32.sqrt() * 0.25]
                })
                .collect()
        };
        let (b1, b2, x1, x2) = (noisy(1.0), noisy(1.0), noisy(1.1), noisy(1.1));
        let exact = vec![[1.1f32]; 40_000];
        let alpha = vec![1.0; 40_000];
        // 10 % off: 0.01 squared, within three deviations.
        for x in [[&exact[..], &exact[..]], [&x1[..], &x2[..]]] {
            let error = image_error(x, [&b1, &b2], &alpha).unwrap().relative;
            assert!((error * error - 0.01).abs() < 0.002, "{error}");
        }
        // Without the halves the noise would count: 0.01 + 0.0625, relative to 1.0625.
        let error = image_error([&exact, &exact], [&b1, &b1], &alpha).unwrap().relative;
        assert!((error * error - 0.0725 / 1.0625).abs() < 0.005, "{error}");
        // Better than the noise can tell is zero, not NaN.
        let (low, high) = ([[0.5f32]], [[1.5f32]]);
        assert_eq!(image_error([&[[1.0]], &[[1.0]]], [&low, &high], &[1.0]).unwrap().relative, 0.0);
    }

    #[test]
    fn bad_input_is_named() {
        let (one, two) = ([[1.0f32]], [[1.0f32]; 2]);
        let size = CompareError::Size { image: "reference", found: 2, expected: 1 };
        assert_eq!(image_error([&one, &one], [&one, &two], &[1.0]), Err(size));
        assert_eq!(image_error([&one, &one], [&one, &one], &[0.0]), Err(CompareError::NoSmoke));
        assert_eq!(image_error([&one, &one], [&one, &[[0.0]]], &[1.0]), Err(CompareError::Black));
        let nan = [[1.0, f32::NAN]; 1];
        let fine = [[1.0f32, 1.0]; 1];
        let error = CompareError::NotFinite { image: "image", pixel: 0 };
        assert_eq!(image_error([&nan, &fine], [&fine, &fine], &[1.0]), Err(error));
        // What is not smoke may be anything.
        assert_eq!(image_error([&nan, &nan], [&fine, &fine], &[0.0]), Err(CompareError::NoSmoke));
    }
}
