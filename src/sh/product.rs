//! The Gaunt tensor: integrals of three basis functions, which make products.

use std::sync::OnceLock;

use super::{COEFFICIENTS, SphereRule, basis};

/// One non-zero entry ∫ y_i y_j y_k dω.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gaunt {
    /// Coefficient of the first factor.
    pub i: usize,
    /// Coefficient of the second factor.
    pub j: usize,
    /// Coefficient of the product.
    pub k: usize,
    /// The integral.
    pub value: f64,
}

/// All non-zero entries for order 4, sorted by (i, j, k); the tensor is symmetric and every order is listed.
pub fn gaunt() -> &'static [Gaunt] {
    static TENSOR: OnceLock<Vec<Gaunt>> = OnceLock::new();
    TENSOR.get_or_init(|| {
        let mut tensor = vec![0.0; COEFFICIENTS * COEFFICIENTS * COEFFICIENTS];
        // y_i y_j y_k has degree 9 at most, which this rule integrates exactly.
        for &(dir, weight) in SphereRule::exact().nodes() {
            let y = basis(dir);
            let mut entry = tensor.iter_mut();
            for yi in y {
                for yj in y {
                    for (yk, sum) in y.iter().zip(&mut entry) {
                        *sum += weight * yi * yj * yk;
                    }
                }
            }
        }
        tensor
            .into_iter()
            .enumerate()
            // The smallest non-zero entry is 0.02; what rounding leaves of the zeros is 1e-16.
            .filter(|&(_, value)| value.abs() > 1e-9)
            .map(|(n, value)| {
                let (ij, k) = (n / COEFFICIENTS, n % COEFFICIENTS);
                Gaunt { i: ij / COEFFICIENTS, j: ij % COEFFICIENTS, k, value }
            })
            .collect()
    })
}
