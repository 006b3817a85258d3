//! Triangles with a place on the texture that covers them.

use glam::{Affine3A, Vec2, Vec3};

/// A surface, or several. Lengths are in metres.
#[derive(Debug, Clone, Default)]
pub(super) struct Mesh {
    pub positions: Vec<Vec3>,
    /// Along the surface, in metres.
    pub uvs: Vec<Vec2>,
    /// Of vertices, counter-clockwise as seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// The surface `at(u, v)` over the unit square, in `columns` × `rows` cells, `size` metres of texture wide and high. Its
    /// outside is where ∂at/∂u × ∂at/∂v points.
    pub fn grid(columns: usize, rows: usize, size: Vec2, at: impl Fn(f32, f32) -> Vec3) -> Mesh {
        let mut mesh = Mesh::default();
        for row in 0..=rows {
            for column in 0..=columns {
                let place = Vec2::new(column as f32 / columns as f32, row as f32 / rows as f32);
                mesh.positions.push(at(place.x, place.y));
                mesh.uvs.push(place * size);
            }
        }
        let vertex = |column: usize, row: usize| (row * (columns + 1) + column) as u32;
        for row in 0..rows {
            for column in 0..columns {
                let [a, b] = [vertex(column, row), vertex(column + 1, row)];
                let [c, d] = [vertex(column, row + 1), vertex(column + 1, row + 1)];
                mesh.triangles.extend([[a, b, d], [a, d, c]]);
            }
        }
        mesh
    }

    /// The rectangle at `corner` along two sides, in cells of `cell` metres or somewhat less. Its outside is where
    /// `along` × `up` points.
    pub fn rectangle(corner: Vec3, along: Vec3, up: Vec3, cell: f32) -> Mesh {
        let size = Vec2::new(along.length(), up.length());
        let cells = (size / cell).ceil().clamp(Vec2::ONE, Vec2::splat(64.));
        Mesh::grid(cells.x as usize, cells.y as usize, size, |u, v| corner + u * along + v * up)
    }

    pub fn join(&mut self, other: Mesh) {
        let first = self.positions.len() as u32;
        self.positions.extend(other.positions);
        self.uvs.extend(other.uvs);
        self.triangles.extend(other.triangles.iter().map(|corners| corners.map(|vertex| first + vertex)));
    }

    /// Moved, turned and scaled; the texture keeps its size.
    pub fn moved(self, by: Affine3A) -> Mesh {
        self.warped(|position| by.transform_point3(position))
    }

    /// With every vertex where `to` takes it.
    pub fn warped(mut self, to: impl Fn(Vec3) -> Vec3) -> Mesh {
        self.positions.iter_mut().for_each(|position| *position = to(*position));
        self
    }

    /// The smallest box around it: its least and its greatest corner.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        let none = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        self.positions.iter().fold(none, |(least, most), &p| (least.min(p), most.max(p)))
    }

    /// For every vertex a place on its triangles, a fifth of the way to their middle: on the edge of a surface that of the next
    /// one begins, and behind that may be anything.
    pub fn insides(&self) -> Vec<Vec3> {
        let mut sums = vec![(Vec3::ZERO, 0.); self.positions.len()];
        for corners in &self.triangles {
            let middle = corners.map(|vertex| self.positions[vertex as usize]).iter().sum::<Vec3>() / 3.;
            for &vertex in corners {
                let (sum, count) = &mut sums[vertex as usize];
                (*sum, *count) = (*sum + middle, *count + 1.);
            }
        }
        let inside = |(&at, &(sum, count)): (&Vec3, &(Vec3, f32))| at.lerp(sum / f32::max(count, 1.), 0.2);
        self.positions.iter().zip(&sums).map(inside).collect()
    }

    /// A unit normal a vertex, the mean of its triangles' by their areas: smooth within a grid, sharp where grids meet.
    pub fn normals(&self) -> Vec<Vec3> {
        let mut normals = vec![Vec3::ZERO; self.positions.len()];
        for corners in &self.triangles {
            let [a, b, c] = corners.map(|vertex| self.positions[vertex as usize]);
            let normal = (b - a).cross(c - a);
            corners.iter().for_each(|&vertex| normals[vertex as usize] += normal);
        }
        normals.into_iter().map(|normal| normal.normalize_or(Vec3::Y)).collect()
    }
}
