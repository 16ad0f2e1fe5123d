//! What comes before the trees: the file's header, the list of grids, and each grid's own header.

use super::DensityError;
use super::cursor::Cursor;
use super::transform::Transform;

/// The first bytes of an OpenVDB file.
pub(in super::super) const MAGIC: [u8; 8] = *b" BDV\0\0\0\0";

/// The file versions this reader knows: 222 brought compression node by node, 225 grids of half-precision type, which
/// leave the others as they were.
const VERSIONS: std::ops::RangeInclusive<u32> = 222..=225;

/// Ends the type of a grid that is saved with half precision.
const HALF_SUFFIX: &str = "_HalfFloat";

/// Separates a grid's name from the number that tells grids of one name apart.
const SEPARATOR: char = '\x1e';

/// The file's list of grids.
pub(super) struct Archive {
    grids: Vec<Descriptor>,
}

/// A grid in the file's list.
pub(super) struct Descriptor {
    /// The name, made unique within the file.
    unique_name: String,
    /// The type of the tree, without a suffix for half precision, such as `Tree_float_5_4_3`.
    pub tree: String,
    /// The type has the suffix for half precision.
    pub half: bool,
    /// The unique name of the grid whose tree this one shares; empty where it has its own.
    pub parent: String,
    /// Where its header begins.
    pub position: usize,
}

impl Archive {
    /// Reads the file's header and its list of grids. Where the file has no offsets, `skip` moves past a grid's data.
    pub fn read(
        bytes: &[u8],
        skip: fn(&mut Cursor, &Descriptor) -> Result<(), DensityError>,
    ) -> Result<Archive, DensityError> {
        const WHAT: &str = "the OpenVDB header";
        let mut at = Cursor::new(bytes);
        if at.take(MAGIC.len(), WHAT)? != MAGIC {
            return Err(DensityError::UnknownFormat);
        }
        let version = at.u32(WHAT)?;
        if !VERSIONS.contains(&version) {
            return Err(DensityError::Unsupported(format!(
                "OpenVDB file version {version} is not supported (only {} to {}): save the file again with a current \
                 version of OpenVDB",
                VERSIONS.start(),
                VERSIONS.end()
            )));
        }
        at.take(8, WHAT)?; // library version
        let has_offsets = at.u8(WHAT)? != 0;
        at.take(36, WHAT)?; // UUID
        read_metadata(&mut at, |_, _| {})?;
        let count = at.i32(WHAT)?;

        let mut grids = Vec::new();
        for _ in 0..count {
            let descriptor = Descriptor::read(&mut at, has_offsets, skip)?;
            grids.push(descriptor);
        }
        Ok(Archive { grids })
    }

    /// The grid of a name, or without one the grid named "density", or the only scalar float grid there is.
    pub fn choose(&self, name: Option<&str>) -> Result<&Descriptor, DensityError> {
        let missing = match name {
            Some(name) => {
                if let Some(grid) = self.grids.iter().find(|grid| grid.display_name() == name) {
                    return Ok(grid);
                }
                let mut named = self.grids.iter().filter(|grid| grid.name() == name);
                match (named.next(), named.next()) {
                    (Some(grid), None) => return Ok(grid),
                    (Some(_), Some(_)) => format!("there are several grids named \"{name}\""),
                    _ => format!("there is no grid named \"{name}\""),
                }
            }
            None => {
                let mut named = self.grids.iter().filter(|grid| grid.name() == "density");
                let mut scalar = self.grids.iter().filter(|grid| grid.is_scalar_float());
                match (named.next(), named.next(), scalar.next(), scalar.next()) {
                    (Some(grid), None, _, _) | (None, _, Some(grid), None) => return Ok(grid),
                    (Some(_), Some(_), _, _) => "there are several grids named \"density\"".into(),
                    (_, _, Some(_), _) => {
                        "no grid is named \"density\" and there are several others: name the one to use".into()
                    }
                    _ => "there is no grid of floats".into(),
                }
            }
        };
        let list: Vec<_> =
            self.grids.iter().map(|grid| format!("{} ({})", grid.display_name(), grid.value_type())).collect();
        let list = if list.is_empty() { "no grids".into() } else { list.join(", ") };
        Err(DensityError::NoSuchGrid(format!("{missing}. The file has: {list}")))
    }

    /// The grid whose tree an instance shares.
    pub fn parent(&self, instance: &Descriptor) -> Result<Option<&Descriptor>, DensityError> {
        if instance.parent.is_empty() {
            return Ok(None);
        }
        let parent = self.grids.iter().find(|grid| grid.unique_name == instance.parent && grid.parent.is_empty());
        parent.map(Some).ok_or_else(|| {
            let name = instance.display_name();
            DensityError::Damaged(format!("the grid \"{name}\" shares the tree of a grid that is not there"))
        })
    }
}

impl Descriptor {
    /// Reads an entry of the list and moves on to the next.
    fn read(
        at: &mut Cursor,
        has_offsets: bool,
        skip: fn(&mut Cursor, &Descriptor) -> Result<(), DensityError>,
    ) -> Result<Descriptor, DensityError> {
        const WHAT: &str = "its list of grids";
        let unique_name = at.string(WHAT)?;
        let tree = at.string(WHAT)?;
        let parent = at.string(WHAT)?;
        let offsets = [at.i64(WHAT)?, at.i64(WHAT)?, at.i64(WHAT)?];
        let (tree, half) = match tree.strip_suffix(HALF_SUFFIX) {
            Some(tree) => (tree.to_string(), true),
            None => (tree, false),
        };
        let mut descriptor = Descriptor { unique_name, tree, half, parent, position: at.position() };
        if has_offsets {
            let [position, _, end] = offsets.map(|offset| usize::try_from(offset).unwrap_or(usize::MAX));
            // Forward only, so that a list cannot go round in circles.
            if position < at.position() || end < position {
                let name = descriptor.display_name();
                return Err(DensityError::Damaged(format!("the offsets of grid \"{name}\" point backwards")));
            }
            descriptor.position = position;
            at.seek(end)?;
        } else {
            skip(at, &descriptor)?;
        }
        Ok(descriptor)
    }

    /// The name as the artist gave it.
    fn name(&self) -> &str {
        self.unique_name.split(SEPARATOR).next().unwrap_or_default()
    }

    /// The name, with a number where several grids have it: `name[1]`.
    pub fn display_name(&self) -> String {
        match self.unique_name.split_once(SEPARATOR) {
            Some((name, number)) => format!("{name}[{number}]"),
            None => self.unique_name.clone(),
        }
    }

    /// The type of the values, such as `float` or `vec3s`.
    pub fn value_type(&self) -> &str {
        let inner = self.tree.strip_prefix("Tree_").and_then(|tree| tree.strip_suffix("_5_4_3"));
        inner.unwrap_or(&self.tree)
    }

    fn is_scalar_float(&self) -> bool {
        matches!(self.value_type(), "float" | "double")
    }
}

/// What stands before a grid's tree.
pub(super) struct GridHeader {
    /// Compression flags: see `values`.
    pub compression: u32,
    /// The metadata's word on whether values are saved with half precision.
    pub half: Option<bool>,
    /// The grid holds distances to a surface.
    pub level_set: bool,
    /// From index space to the world.
    pub transform: Transform,
}

impl GridHeader {
    pub fn read(at: &mut Cursor) -> Result<GridHeader, DensityError> {
        let compression = at.u32("a grid's header")?;
        let (mut half, mut level_set) = (None, false);
        read_metadata(at, |name, value| match name {
            "is_saved_as_half_float" => half = Some(value != [0]),
            "class" => level_set = value == b"level set",
            _ => {}
        })?;
        let transform = Transform::read(at)?;
        Ok(GridHeader { compression, half, level_set, transform })
    }
}

/// Reads a metadata table: `visit` gets every entry's name and bytes.
fn read_metadata(at: &mut Cursor, mut visit: impl FnMut(&str, &[u8])) -> Result<(), DensityError> {
    const WHAT: &str = "metadata";
    for _ in 0..at.u32(WHAT)? {
        let name = at.string(WHAT)?;
        at.string(WHAT)?; // type
        let length = at.u32(WHAT)? as usize;
        visit(&name, at.take(length, WHAT)?);
    }
    Ok(())
}
