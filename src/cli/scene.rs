//! The scene file of `smoke render`: a medium, its light and a camera, as JSON.
//!
//! Paths are relative to the file. Unknown keys are warnings; a value that makes no sense is an error that names its key.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, ensure};
use glam::DVec3;
use serde_json::{Map, Value};

use crate::density::{GridShape, Placement};
use crate::sh::{ShRgb, SphereRule};

/// Everything `smoke render` needs to know beside the smoke itself.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The density file or bundle, if the scene names one.
    pub density: Option<PathBuf>,
    /// Where the box of the density lies in the world.
    pub placement: ScenePlacement,
    /// Extinction per metre where the density is 1, at least 0.
    pub sigma_t: f64,
    /// Single-scattering albedo per colour, 0 to 1.
    pub albedo: DVec3,
    /// Henyey–Greenstein asymmetry, between −1 and 1; above 0 scatters forward.
    pub g: f64,
    /// Light from infinitely far away.
    pub environment: Environment,
    /// Sharp lights, which may be inside the smoke.
    pub lights: Vec<SceneLight>,
    /// Ground, or a ceiling: a horizontal plane.
    pub plane: Option<ScenePlane>,
    /// Balls.
    pub spheres: Vec<SceneSphere>,
    /// The pinhole camera.
    pub camera: SceneCamera,
}

/// Where the box of the density lies in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ScenePlacement {
    /// Where the density file itself puts it.
    File,
    /// Centred on the origin, its longest side this many metres.
    Width(f64),
}

/// Light from infinitely far away, linear RGB radiance.
#[derive(Clone, Debug, PartialEq)]
pub enum Environment {
    /// A constant and smooth lobes: exactly 16 spherical harmonics.
    Lobes {
        /// Radiance from everywhere.
        ambient: DVec3,
        /// Lobes on top of it.
        lobes: Vec<Lobe>,
    },
    /// An equirectangular image: column 0.5 looks to +Z, row 0 is up.
    Equirect(PathBuf),
}

/// A smooth light, `rgb · (1 + t)(t + 0.3)² / 3.38` with `t` the cosine to `direction`: `rgb` at its centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lobe {
    /// Unit vector toward the light.
    pub direction: DVec3,
    /// Radiance at the centre.
    pub rgb: DVec3,
}

/// A sharp light. Directions are unit vectors, lengths in metres, angles in degrees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SceneLight {
    /// A distant disc of constant radiance.
    Sun {
        /// Toward the sun.
        direction: DVec3,
        /// RGB irradiance on a surface that faces it.
        irradiance: DVec3,
        /// Its diameter, 0 to 179; 0 is a direction alone.
        angle_deg: f64,
    },
    /// A point that shines the same in all directions.
    Point {
        /// Where it is.
        position: DVec3,
        /// RGB intensity in radiance units × m²: irradiance is `intensity`/d² at distance d.
        intensity: DVec3,
    },
    /// A point that shines in a cone, as Bevy's spot lights do.
    Spot {
        /// Where it is.
        position: DVec3,
        /// Along which it shines.
        direction: DVec3,
        /// RGB intensity within the inner cone, as of a point.
        intensity: DVec3,
        /// Half-angle of the cone of full intensity, 0 to `outer_deg`.
        inner_deg: f64,
        /// Half-angle beyond which there is no light, 0.01 to 90.
        outer_deg: f64,
    },
}

/// A horizontal plane, opaque and Lambertian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScenePlane {
    /// Its height in metres.
    pub y: f64,
    /// Share of the light that it reflects, 0 to 1.
    pub albedo: DVec3,
}

/// A ball, opaque and Lambertian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneSphere {
    /// Its centre in metres.
    pub center: DVec3,
    /// Its radius in metres, above 0.
    pub radius: f64,
    /// Share of the light that it reflects, 0 to 1.
    pub albedo: DVec3,
}

/// A pinhole camera with +Y up; the picture's top row comes first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneCamera {
    /// Position in metres.
    pub eye: DVec3,
    /// The point in the middle of the picture.
    pub target: DVec3,
    /// Vertical field of view in degrees, between 0 and 180.
    pub fov_y_deg: f64,
    /// Width and height in pixels.
    pub size: [u32; 2],
}

impl ScenePlacement {
    /// World position of the centre of a box of cells, and the world length of its longest side.
    pub fn center_and_side(self, shape: GridShape, file: Placement) -> (DVec3, f64) {
        match self {
            Self::File => (file.center, file.voxel_size * f64::from(shape.longest())),
            Self::Width(width) => (DVec3::ZERO, width),
        }
    }
}

impl SceneCamera {
    /// Direction from the eye through a point of a picture of `size`, in pixels from its top left corner.
    pub fn direction(&self, size: [u32; 2], x: f64, y: f64) -> DVec3 {
        let forward = (self.target - self.eye).normalize();
        let right = forward.cross(DVec3::Y).normalize();
        let [width, height] = size.map(f64::from);
        let half_height = (0.5 * self.fov_y_deg).to_radians().tan();
        let (across, up) = ((2.0 * x - width) / height * half_height, (1.0 - 2.0 * y / height) * half_height);
        (forward + right * across + right.cross(forward) * up).normalize()
    }
}

impl Environment {
    /// Radiance from direction `w` (a unit vector away from the scene); `None` for an image.
    pub fn radiance(&self, w: DVec3) -> Option<DVec3> {
        let Self::Lobes { ambient, lobes } = self else {
            return None;
        };
        let lobe = |lobe: &Lobe| {
            let t = w.dot(lobe.direction);
            lobe.rgb * ((1.0 + t) * (t + 0.3).powi(2) / 3.38)
        };
        Some(*ambient + lobes.iter().map(lobe).sum::<DVec3>())
    }

    /// The 16 RGB coefficients `∫ L(ω) y_k(ω) dω`, in world axes; `None` for an image.
    ///
    /// Radiance and basis are polynomials of degree 3, so that a rule exact through degree 7 gives the integral to
    /// rounding.
    pub fn coefficients(&self) -> Option<ShRgb> {
        let Self::Lobes { .. } = self else { return None };
        Some(ShRgb::project(&SphereRule::new(4), |w| self.radiance(w).unwrap_or_default()))
    }
}

impl Scene {
    /// Whether there is anything but smoke.
    pub fn has_surfaces(&self) -> bool {
        self.plane.is_some() || !self.spheres.is_empty()
    }

    /// Reads a scene file; the second value is its warnings, one line each.
    pub fn read(path: &Path) -> anyhow::Result<(Self, Vec<String>)> {
        let name = path.display();
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {name}"))?;
        let folder = path.parent().unwrap_or(Path::new(""));
        Self::parse(&text, folder).with_context(|| format!("scene {name}"))
    }

    /// The same from text; `folder` is what its paths are relative to.
    pub fn parse(text: &str, folder: &Path) -> anyhow::Result<(Self, Vec<String>)> {
        let value: Value = serde_json::from_str(text)?;
        let mut warnings = Vec::new();
        let mut top = Keys::new("", &value, folder)?;

        let width = top.optional("width_m", positive)?;
        let placement = match (top.required("placement", text_value)?.as_str(), width) {
            ("file", _) => ScenePlacement::File,
            ("width", Some(width)) => ScenePlacement::Width(width),
            ("width", None) => return Err(anyhow!("missing key width_m, which placement \"width\" needs")),
            (other, _) => return Err(anyhow!("placement: \"{other}\" is neither \"file\" nor \"width\"")),
        };
        let scene = Self {
            density: top.optional("density", text_value)?.map(|path| folder.join(path)),
            placement,
            sigma_t: top.required("sigma_t", not_negative)?,
            albedo: top.required("albedo", |v| Ok(DVec3::from(triple(v, share)?)))?,
            g: top.required("g", |v| {
                let g = number(v)?;
                ensure!(g.abs() < 1.0, "{g} is not between -1 and 1");
                Ok(g)
            })?,
            environment: environment(top.nested("env")?, &mut warnings)?,
            lights: top
                .optional_list("lights")?
                .into_iter()
                .map(|keys| light(keys, &mut warnings))
                .collect::<anyhow::Result<_>>()?,
            plane: top.optional_nested("plane")?.map(|keys| plane(keys, &mut warnings)).transpose()?,
            spheres: top
                .optional_list("spheres")?
                .into_iter()
                .map(|keys| sphere(keys, &mut warnings))
                .collect::<anyhow::Result<_>>()?,
            camera: SceneCamera {
                eye: top.required("eye", vector)?,
                target: top.required("target", vector)?,
                fov_y_deg: top.required("fov_y_deg", |v| {
                    let fov = number(v)?;
                    ensure!(fov > 0.0 && fov < 180.0, "{fov} is not between 0 and 180 degrees");
                    Ok(fov)
                })?,
                size: top.required("size", picture_size)?,
            },
        };
        let view = scene.camera.target - scene.camera.eye;
        ensure!(view.length() > 0.0, "target: the same point as eye");
        ensure!(
            view.normalize().cross(DVec3::Y).length() > 1e-6,
            "target: straight above or below eye, where +Y cannot be up in the picture"
        );
        top.unused(&mut warnings);
        Ok((scene, warnings))
    }
}

fn environment(mut keys: Keys, warnings: &mut Vec<String>) -> anyhow::Result<Environment> {
    let environment = match keys.required("kind", text_value)?.as_str() {
        "lobes" => Environment::Lobes {
            ambient: keys.required("ambient", color)?,
            lobes: keys
                .list("lobes")?
                .into_iter()
                .map(|mut lobe| {
                    let direction = lobe.required("dir", direction)?;
                    let rgb = lobe.required("rgb", color)?;
                    lobe.unused(warnings);
                    Ok(Lobe { direction, rgb })
                })
                .collect::<anyhow::Result<_>>()?,
        },
        "equirect" => Environment::Equirect(keys.folder.join(keys.required("path", text_value)?)),
        "constant" => Environment::Lobes { ambient: keys.required("rgb", color)?, lobes: Vec::new() },
        other => {
            return Err(anyhow!("env.kind: \"{other}\" is none of \"lobes\", \"equirect\", \"constant\""));
        }
    };
    keys.unused(warnings);
    Ok(environment)
}

fn light(mut keys: Keys, warnings: &mut Vec<String>) -> anyhow::Result<SceneLight> {
    let light = match keys.required("kind", text_value)?.as_str() {
        "sun" => SceneLight::Sun {
            direction: keys.required("dir", direction)?,
            irradiance: keys.required("irradiance", color)?,
            angle_deg: keys.optional("angle_deg", |v| degrees(v, 0.0, 179.0))?.unwrap_or(0.0),
        },
        "point" => {
            SceneLight::Point { position: keys.required("pos", vector)?, intensity: keys.required("intensity", color)? }
        }
        "spot" => {
            let outer_deg = keys.required("outer_deg", |v| degrees(v, 0.01, 90.0))?;
            SceneLight::Spot {
                position: keys.required("pos", vector)?,
                direction: keys.required("dir", direction)?,
                intensity: keys.required("intensity", color)?,
                inner_deg: keys.required("inner_deg", |v| degrees(v, 0.0, outer_deg))?,
                outer_deg,
            }
        }
        other => return Err(anyhow!("{}kind: \"{other}\" is none of \"sun\", \"point\", \"spot\"", keys.prefix)),
    };
    keys.unused(warnings);
    Ok(light)
}

fn plane(mut keys: Keys, warnings: &mut Vec<String>) -> anyhow::Result<ScenePlane> {
    let plane = ScenePlane { y: keys.required("y", number)?, albedo: keys.required("albedo", reflectance)? };
    keys.unused(warnings);
    Ok(plane)
}

fn sphere(mut keys: Keys, warnings: &mut Vec<String>) -> anyhow::Result<SceneSphere> {
    let sphere = SceneSphere {
        center: keys.required("center", vector)?,
        radius: keys.required("radius", positive)?,
        albedo: keys.required("albedo", reflectance)?,
    };
    keys.unused(warnings);
    Ok(sphere)
}

/// The keys of a JSON object, and which of them have been read.
struct Keys<'a> {
    /// What comes before a key in messages: empty, `env.`, `env.lobes[0].`
    prefix: String,
    object: &'a Map<String, Value>,
    folder: &'a Path,
    read: Vec<&'static str>,
}

impl<'a> Keys<'a> {
    fn new(prefix: &str, value: &'a Value, folder: &'a Path) -> anyhow::Result<Self> {
        let named = if prefix.is_empty() { "the file" } else { prefix.trim_end_matches('.') };
        let object = value.as_object().ok_or_else(|| anyhow!("{named}: not an object {{…}}"))?;
        Ok(Self { prefix: prefix.into(), object, folder, read: Vec::new() })
    }

    fn optional<T>(
        &mut self,
        key: &'static str,
        parse: impl FnOnce(&Value) -> anyhow::Result<T>,
    ) -> anyhow::Result<Option<T>> {
        self.read.push(key);
        let value = self.object.get(key).map(parse).transpose();
        // The reason joins the key in one message, as the two only make sense together.
        value.map_err(|error| anyhow!("{}{key}: {error}", self.prefix))
    }

    fn required<T>(&mut self, key: &'static str, parse: impl FnOnce(&Value) -> anyhow::Result<T>) -> anyhow::Result<T> {
        let value = self.optional(key, parse)?;
        value.ok_or_else(|| anyhow!("missing key {}{key}", self.prefix))
    }

    fn value(&mut self, key: &'static str) -> anyhow::Result<&'a Value> {
        self.read.push(key);
        self.object.get(key).ok_or_else(|| anyhow!("missing key {}{key}", self.prefix))
    }

    fn nested(&mut self, key: &'static str) -> anyhow::Result<Keys<'a>> {
        let value = self.value(key)?;
        Keys::new(&format!("{}{key}.", self.prefix), value, self.folder)
    }

    fn optional_nested(&mut self, key: &'static str) -> anyhow::Result<Option<Keys<'a>>> {
        self.object.contains_key(key).then(|| self.nested(key)).transpose()
    }

    fn list(&mut self, key: &'static str) -> anyhow::Result<Vec<Keys<'a>>> {
        let name = format!("{}{key}", self.prefix);
        let items = self.value(key)?.as_array().ok_or_else(|| anyhow!("{name}: not a list […]"))?;
        let keys = |(i, item)| Keys::new(&format!("{name}[{i}]."), item, self.folder);
        items.iter().enumerate().map(keys).collect()
    }

    fn optional_list(&mut self, key: &'static str) -> anyhow::Result<Vec<Keys<'a>>> {
        if self.object.contains_key(key) { self.list(key) } else { Ok(Vec::new()) }
    }

    /// Warns of every key that nobody asked for.
    fn unused(&self, warnings: &mut Vec<String>) {
        for key in self.object.keys().filter(|key| !self.read.contains(&key.as_str())) {
            warnings.push(format!("{}{key}: unknown key, ignored", self.prefix));
        }
    }
}

fn text_value(value: &Value) -> anyhow::Result<String> {
    value.as_str().map(String::from).ok_or_else(|| anyhow!("{value} is not a text"))
}

fn number(value: &Value) -> anyhow::Result<f64> {
    let number = value.as_f64().ok_or_else(|| anyhow!("{value} is not a number"))?;
    ensure!(number.is_finite(), "{value} is not a finite number");
    Ok(number)
}

fn not_negative(value: &Value) -> anyhow::Result<f64> {
    let number = number(value)?;
    ensure!(number >= 0.0, "{number} is negative");
    Ok(number)
}

fn positive(value: &Value) -> anyhow::Result<f64> {
    let number = number(value)?;
    ensure!(number > 0.0, "{number} is not above 0");
    Ok(number)
}

fn share(value: &Value) -> anyhow::Result<f64> {
    let number = number(value)?;
    ensure!((0.0..=1.0).contains(&number), "{number} is not between 0 and 1");
    Ok(number)
}

fn triple(value: &Value, parse: fn(&Value) -> anyhow::Result<f64>) -> anyhow::Result<[f64; 3]> {
    match value.as_array().map(Vec::as_slice) {
        Some([x, y, z]) => Ok([parse(x)?, parse(y)?, parse(z)?]),
        _ => Err(anyhow!("{value} is not a list of three numbers")),
    }
}

fn vector(value: &Value) -> anyhow::Result<DVec3> {
    Ok(DVec3::from(triple(value, number)?))
}

fn direction(value: &Value) -> anyhow::Result<DVec3> {
    vector(value)?.try_normalize().ok_or_else(|| anyhow!("not a direction"))
}

/// Three numbers, or one for all three.
fn color(value: &Value) -> anyhow::Result<DVec3> {
    match value {
        Value::Array(_) => Ok(triple(value, not_negative)?.into()),
        Value::Number(_) => Ok(DVec3::splat(not_negative(value)?)),
        _ => Err(anyhow!("{value} is neither a number nor three, [r, g, b]")),
    }
}

/// Three shares, or one for all three.
fn reflectance(value: &Value) -> anyhow::Result<DVec3> {
    let rgb = color(value)?;
    ensure!(rgb.max_element() <= 1.0, "{value} is above 1");
    Ok(rgb)
}

fn degrees(value: &Value, low: f64, high: f64) -> anyhow::Result<f64> {
    let degrees = number(value)?;
    ensure!((low..=high).contains(&degrees), "{degrees} is not between {low} and {high} degrees");
    Ok(degrees)
}

fn picture_size(value: &Value) -> anyhow::Result<[u32; 2]> {
    let side = |value: &Value| match value.as_u64() {
        Some(side @ 1..=16_384) => Ok(side as u32),
        _ => Err(anyhow!("{value} is not a whole number of pixels from 1 to 16384")),
    };
    match value.as_array().map(Vec::as_slice) {
        Some([width, height]) => Ok([side(width)?, side(height)?]),
        _ => Err(anyhow!("{value} is not [width, height]")),
    }
}

#[cfg(test)]
mod tests;
