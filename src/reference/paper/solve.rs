//! The paper's solver: conjugate gradients on the normal equations (Zhou et al. 2008, section 5.4).

/// A dense square matrix.
#[derive(Clone, Debug, PartialEq)]
pub struct Matrix {
    /// Rows and columns.
    pub size: usize,
    /// `size`² entries, row by row.
    pub values: Vec<f64>,
}

impl Matrix {
    /// A x.
    pub fn multiply(&self, x: &[f64]) -> Vec<f64> {
        self.values.chunks_exact(self.size.max(1)).map(|row| dot(row, x)).collect()
    }

    /// Aᵀ x.
    pub fn multiply_transposed(&self, x: &[f64]) -> Vec<f64> {
        let mut product = vec![0.0; self.size];
        for (row, &x) in self.values.chunks_exact(self.size.max(1)).zip(x) {
            add_scaled(&mut product, x, row);
        }
        product
    }
}

/// `steps` steps of conjugate gradients on AᵀA x = Aᵀb from `x`, fewer where the residual reaches zero.
///
/// The paper multiplies out AᵀA; Aᵀ(A x) is the same but for rounding.
pub fn conjugate_gradients(matrix: &Matrix, rhs: &[f64], mut x: Vec<f64>, steps: usize) -> Vec<f64> {
    let normal = |x: &[f64]| matrix.multiply_transposed(&matrix.multiply(x));
    let mut residual = matrix.multiply_transposed(rhs);
    // A residual this small is rounding.
    let zero = f64::EPSILON.powi(2) * dot(&residual, &residual);
    add_scaled(&mut residual, -1.0, &normal(&x));
    let mut direction = residual.clone();
    let mut power = dot(&residual, &residual);
    for _ in 0..steps {
        if power <= zero {
            break;
        }
        let image = normal(&direction);
        let step = power / dot(&direction, &image);
        add_scaled(&mut x, step, &direction);
        add_scaled(&mut residual, -step, &image);
        let next = dot(&residual, &residual);
        let ratio = next / power;
        for (d, r) in direction.iter_mut().zip(&residual) {
            *d = r + ratio * *d;
        }
        power = next;
    }
    x
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn add_scaled(sum: &mut [f64], factor: f64, x: &[f64]) {
    for (sum, x) in sum.iter_mut().zip(x) {
        *sum += factor * x;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gaussian elimination with partial pivoting.
    fn eliminate(matrix: &Matrix, rhs: &[f64]) -> Vec<f64> {
        let n = matrix.size;
        let mut rows: Vec<Vec<f64>> =
            matrix.values.chunks_exact(n).zip(rhs).map(|(row, &b)| [row, &[b]].concat()).collect();
        for column in 0..n {
            let pivot = (column..n).max_by(|&i, &j| rows[i][column].abs().total_cmp(&rows[j][column].abs())).unwrap();
            rows.swap(column, pivot);
            let (done, rest) = rows.split_at_mut(column + 1);
            for row in rest {
                let factor = row[column] / done[column][column];
                add_scaled(&mut row[column..], -factor, &done[column][column..]);
            }
        }
        let mut x = vec![0.0; n];
        for i in (0..n).rev() {
            x[i] = (rows[i][n] - dot(&rows[i][i + 1..n], &x[i + 1..])) / rows[i][i];
        }
        x
    }

    fn example() -> (Matrix, Vec<f64>) {
        // Not symmetric; its diagonal dominates, so that its condition number is below 10.
        let size = 30;
        let values =
            (0..size * size).map(|i| (1.3 * i as f64).sin() + if i % (size + 1) == 0 { 12.0 } else { 0.0 }).collect();
        (Matrix { size, values }, (0..size).map(|i| (0.7 * i as f64).cos()).collect())
    }

    #[test]
    fn converged_it_is_the_dense_solution() {
        let (matrix, rhs) = example();
        let expected = eliminate(&matrix, &rhs);
        let found = conjugate_gradients(&matrix, &rhs, vec![0.0; 30], 200);
        for (a, b) in found.iter().zip(&expected) {
            assert!((a - b).abs() < 1e-12, "{a} {b}");
        }
        for (a, b) in matrix.multiply(&expected).iter().zip(&rhs) {
            assert!((a - b).abs() < 1e-13, "{a} {b}");
        }
    }

    #[test]
    fn steps_and_start_count() {
        let (matrix, rhs) = example();
        let expected = eliminate(&matrix, &rhs);
        let error = |start: &[f64], steps| {
            let mut x = conjugate_gradients(&matrix, &rhs, start.to_vec(), steps);
            add_scaled(&mut x, -1.0, &expected);
            dot(&x, &x).sqrt()
        };
        let zero = vec![0.0; 30];
        let errors = [0, 2, 4, 8].map(|steps| error(&zero, steps));
        assert!(errors.windows(2).all(|e| e[1] < e[0]), "{errors:?}");
        let warm: Vec<f64> = expected.iter().map(|x| 0.99 * x).collect();
        assert!(error(&warm, 2) < 0.02 * errors[1]);
        // The solution itself stays, as far as rounding lets it.
        assert!(error(&expected, 5) < 1e-13);
    }

    #[test]
    fn singular_systems_stay_finite() {
        // Two equal rows and columns: the least-squares solution of smallest norm shares evenly.
        let matrix = Matrix { size: 2, values: vec![1.0; 4] };
        let found = conjugate_gradients(&matrix, &[3.0, 3.0], vec![0.0; 2], 10);
        assert!((found[0] - 1.5).abs() + (found[1] - 1.5).abs() < 1e-12, "{found:?}");
        assert!(conjugate_gradients(&Matrix { size: 0, values: vec![] }, &[], vec![], 3).is_empty());
        assert_eq!(conjugate_gradients(&matrix, &[0.0, 0.0], vec![0.0; 2], 3), [0.0, 0.0]);
    }
}
