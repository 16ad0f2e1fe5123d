//! Environment: a radiance image becomes 16 RGB coefficients, L_k = ∫ L(ω) y_k(ω) dω.

use core::f64::consts::PI;

use glam::DVec3;

use crate::sh::ShRgb;

/// Projects an equirectangular image: rows of `width` texels, the top row looking up (+Y), the middle column at +Z,
/// ω = (sin φ sin θ, cos θ, −cos φ sin θ) with φ = 2πu and θ = πv. A row's weight is its exact solid angle.
pub fn equirect(width: usize, texels: &[DVec3]) -> ShRgb {
    let width = width.max(1);
    let height = texels.len() / width;
    let (step_phi, step_theta) = (2.0 * PI / width as f64, PI / height as f64);
    let mut sh = ShRgb::default();
    for (row, texels) in texels.chunks_exact(width).enumerate() {
        let theta = (row as f64 + 0.5) * step_theta;
        let solid_angle = 2.0 * theta.sin() * (0.5 * step_theta).sin() * step_phi;
        for (column, &radiance) in texels.iter().enumerate() {
            let phi = (column as f64 + 0.5) * step_phi;
            let dir = DVec3::new(phi.sin() * theta.sin(), theta.cos(), -phi.cos() * theta.sin());
            sh.accumulate(dir, radiance * solid_angle);
        }
    }
    sh
}

/// Projects a cubemap: the faces +X −X +Y −Y +Z −Z, `size`² texels each, laid out as wgpu stores and Bevy samples them.
/// Radiance is summed with the texels' approximate solid angle 4/N² (1+u²+v²)^(−3/2).
pub fn cubemap(size: usize, faces: [&[DVec3]; 6]) -> ShRgb {
    let mut sh = ShRgb::default();
    for (face, texels) in faces.into_iter().enumerate() {
        for (row, texels) in texels.chunks_exact(size.max(1)).enumerate() {
            for (column, &radiance) in texels.iter().enumerate() {
                let (dir, length_squared) = cubemap_direction(size, face, column, row);
                let solid_angle = 4.0 / (size * size) as f64 * length_squared.powf(-1.5);
                sh.accumulate(dir, radiance * solid_angle);
            }
        }
    }
    sh
}

/// The world direction of a texel's centre, and the squared distance of its place on the cube of half side 1.
pub fn cubemap_direction(size: usize, face: usize, column: usize, row: usize) -> (DVec3, f64) {
    let u = 2.0 * (column as f64 + 0.5) / size as f64 - 1.0;
    let v = 2.0 * (row as f64 + 0.5) / size as f64 - 1.0;
    // The map's own axes: u to the right and v down on each face, seen from inside a left-handed cube.
    let map = match face {
        0 => DVec3::new(1.0, -v, -u),
        1 => DVec3::new(-1.0, -v, u),
        2 => DVec3::new(u, 1.0, v),
        3 => DVec3::new(u, -1.0, -v),
        4 => DVec3::new(u, -v, 1.0),
        _ => DVec3::new(-u, -v, -1.0),
    };
    // Bevy looks up a world direction (x, y, z) at (x, y, −z).
    let world = DVec3::new(map.x, map.y, -map.z);
    (world.normalize(), world.length_squared())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sh::fibonacci;

    fn equirect_of(height: usize, f: impl Fn(DVec3) -> DVec3) -> ShRgb {
        let width = 2 * height;
        let texels: Vec<_> = (0..width * height)
            .map(|i| {
                let (u, v) = (((i % width) as f64 + 0.5) / width as f64, ((i / width) as f64 + 0.5) / height as f64);
                let (phi, theta) = (2.0 * PI * u, PI * v);
                f(DVec3::new(phi.sin() * theta.sin(), theta.cos(), -phi.cos() * theta.sin()))
            })
            .collect();
        equirect(width, &texels)
    }

    fn cubemap_of(size: usize, f: impl Fn(DVec3) -> DVec3) -> ShRgb {
        let faces: Vec<Vec<DVec3>> = (0..6)
            .map(|face| (0..size * size).map(|i| f(cubemap_direction(size, face, i % size, i / size).0)).collect())
            .collect();
        cubemap(size, core::array::from_fn(|face| faces[face].as_slice()))
    }

    fn assert_close(a: &ShRgb, b: &ShRgb, tolerance: f64) {
        for (k, (a, b)) in a.0.iter().zip(&b.0).enumerate() {
            assert!((*a - *b).abs().max_element() < tolerance, "{k}: {a} for {b}");
        }
    }

    /// The scenes' lobe (1+t)(t+0.3)²/3.38 = (t³ + 1.6t² + 0.69t + 0.09)/3.38, with its factors by hand:
    /// t² = (1 + 2 P2)/3, t³ = (3 P1 + 2 P3)/5, and 2π∫P_l² = 4π/(2l+1).
    fn lobe(dir: DVec3, rgb: DVec3) -> (impl Fn(DVec3) -> DVec3, ShRgb) {
        let factors = [0.09 + 1.6 / 3.0, (0.69 + 0.6) / 3.0, 1.6 * 2.0 / 3.0 / 5.0, 2.0 / 5.0 / 7.0];
        let f = move |w: DVec3| {
            let t = w.dot(dir);
            rgb * ((1.0 + t) * (t + 0.3) * (t + 0.3) / 3.38)
        };
        (f, ShRgb::zonal(dir, &factors.map(|c| c * 4.0 * PI / 3.38), rgb))
    }

    #[test]
    fn constant_images() {
        let rgb = DVec3::new(1.0, 2.0, 0.5);
        // Row weights sum to 4π exactly (8192 roundings) and the columns are symmetric: only y6 sees the second-order
        // error in θ, about (π/64)²/4 of √(4π).
        let sh = equirect_of(64, |_| rgb);
        assert!((sh.0[0] - ShRgb::constant(rgb).0[0]).abs().max_element() < 1e-11);
        assert_close(&sh, &ShRgb::constant(rgb), 2e-3);
        // The texels' solid angles are approximate: 1 + O(1/N²), N = 64.
        assert_close(&cubemap_of(64, |_| rgb), &ShRgb::constant(rgb), 2e-3);
    }

    #[test]
    fn lobes_project_to_their_coefficients() {
        let (up, a) = lobe(DVec3::new(0.2, 0.9, -0.3).normalize(), DVec3::new(3.0, 2.0, 1.0));
        let (side, b) = lobe(DVec3::new(-0.7, 0.1, 0.6).normalize(), DVec3::new(0.5, 1.0, 2.0));
        let expected = a + b;
        // Midpoint rules: second order in the texel's size, and four times better with twice the resolution.
        let error = |sh: ShRgb| {
            let difference = sh + expected * -1.0;
            difference.0.iter().fold(0.0f64, |worst, c| worst.max(c.abs().max_element()))
        };
        for (coarse, fine) in [
            (equirect_of(64, |w| up(w) + side(w)), equirect_of(128, |w| up(w) + side(w))),
            (cubemap_of(32, |w| up(w) + side(w)), cubemap_of(64, |w| up(w) + side(w))),
        ] {
            let (coarse, fine) = (error(coarse), error(fine));
            assert!(fine < 1e-3, "{fine}");
            assert!((3.5..4.5).contains(&(coarse / fine)), "{coarse} {fine}");
        }
    }

    #[test]
    fn cubemap_agrees_with_equirect() {
        // No polynomial, and nothing symmetric about it.
        let f = |w: DVec3| DVec3::new((2.0 * w.x + w.y).exp(), (3.0 * w.z).cos() + 1.0 - w.y, (w.x - w.z).powi(2));
        assert_close(&cubemap_of(128, f), &equirect_of(256, f), 2e-3);
    }

    #[test]
    fn texels_look_where_they_should() {
        // One bright texel of an image of 5 × 3: the middle of the middle row is +Z, the middle of the top row up and
        // 60° off the horizon towards +Z; a quarter to the left (φ = 108°, the nearest column) is mostly +X.
        let brightest = |texel: usize| {
            let mut texels = [DVec3::ZERO; 15];
            texels[texel] = DVec3::ONE;
            let sh = equirect(5, &texels);
            DVec3::new(-sh.0[3].x, -sh.0[1].x, sh.0[2].x).normalize()
        };
        assert!((brightest(7) - DVec3::Z).length() < 1e-14);
        assert!((brightest(2) - DVec3::new(0.0, 3f64.sqrt() / 2.0, 0.5)).length() < 1e-14);
        let (sin, cos) = 108f64.to_radians().sin_cos();
        assert!((brightest(6) - DVec3::new(sin, 0.0, -cos)).length() < 1e-14);
    }

    #[test]
    fn faces_look_where_they_should() {
        // Face centres in world space: +Z and −Z are exchanged by Bevy's flip. A bright face pulls band 1 towards it.
        let centers = [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y, -DVec3::Z, DVec3::Z];
        let (dark, bright) = (vec![DVec3::ZERO; 16], vec![DVec3::ONE; 16]);
        for (face, center) in centers.into_iter().enumerate() {
            let sh = cubemap(4, core::array::from_fn(|i| if i == face { bright.as_slice() } else { &dark }));
            let brightest = fibonacci(500).max_by(|a, b| sh.evaluate(*a).x.total_cmp(&sh.evaluate(*b).x)).unwrap();
            assert!(brightest.dot(center) > 0.95, "{face}: {brightest}");
        }
        // The top left and top right corners of each face, from the table of the Vulkan specification with z flipped.
        // Seen from inside, with +Y up, every image reads the right way round.
        let [l, h] = [-1.0, 1.0];
        let corners = [
            ([h, h, l], [h, h, h]),
            ([l, h, h], [l, h, l]),
            ([l, h, h], [h, h, h]),
            ([l, l, l], [h, l, l]),
            ([l, h, l], [h, h, l]),
            ([h, h, h], [l, h, h]),
        ];
        for (face, (left, right)) in corners.into_iter().enumerate() {
            let corner = |column| cubemap_direction(1000, face, column, 0).0 * 3f64.sqrt();
            assert!((corner(0) - DVec3::from(left)).length() < 0.01, "{face}");
            assert!((corner(999) - DVec3::from(right)).length() < 0.01, "{face}");
        }
    }
}
