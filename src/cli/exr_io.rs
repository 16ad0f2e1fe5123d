//! OpenEXR in and out: 32-bit linear images, as `smoke render` writes and `smoke compare` reads them.

use std::path::Path;

use anyhow::{Context, anyhow, bail, ensure};
use exr::prelude::{ReadChannels, ReadLayers, SpecificChannels, WritableImage, read as exr_read};

/// A flat OpenEXR image, every channel as `f32`, top row first.
#[derive(Clone, Debug, PartialEq)]
pub struct ExrImage {
    /// Width and height in pixels.
    pub size: [usize; 2],
    channels: Vec<(String, Vec<f32>)>,
}

impl ExrImage {
    /// Reads the first layer of a file at full resolution; half, float and integer channels alike.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let image = exr_read()
            .no_deep_data()
            .largest_resolution_level()
            .all_channels()
            .first_valid_layer()
            .all_attributes()
            .from_file(path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        let layer = image.layer_data;
        let size = [layer.size.x(), layer.size.y()];
        let mut channels = Vec::new();
        for channel in layer.channel_data.list {
            let values: Vec<f32> = channel.sample_data.values_as_f32().collect();
            ensure!(
                values.len() == size[0] * size[1],
                "{}: channel {} is subsampled; write it at full resolution",
                path.display(),
                channel.name
            );
            channels.push((channel.name.to_string(), values));
        }
        Ok(Self { size, channels })
    }

    /// The samples of one channel.
    pub fn channel(&self, name: &str) -> Option<&[f32]> {
        self.channels.iter().find(|(n, _)| n == name).map(|(_, values)| values.as_slice())
    }

    /// The colour of every pixel, from the channels R, G and B.
    pub fn rgb(&self) -> anyhow::Result<Vec<[f32; 3]>> {
        match ["R", "G", "B"].map(|name| self.channel(name)) {
            [Some(r), Some(g), Some(b)] => Ok(r.iter().zip(g).zip(b).map(|((r, g), b)| [*r, *g, *b]).collect()),
            _ => Err(anyhow!("no R, G and B channels among {}", self.channel_names())),
        }
    }

    /// The alpha of every pixel: channel A, or the only channel of a single-channel image (Y as a rule).
    pub fn alpha(&self) -> anyhow::Result<&[f32]> {
        match (self.channel("A"), self.channels.as_slice()) {
            (Some(alpha), _) => Ok(alpha),
            (None, [(_, alpha)]) => Ok(alpha),
            _ => bail!("no A channel, and not one single channel, among {}", self.channel_names()),
        }
    }

    fn channel_names(&self) -> String {
        let names: Vec<&str> = self.channels.iter().map(|(name, _)| name.as_str()).collect();
        names.join(", ")
    }
}

/// An OpenEXR file with channels R, G, B, A as 32-bit floats, losslessly compressed; `pixels` in rows, top row first.
pub fn encode_rgba(width: usize, height: usize, pixels: &[[f32; 4]]) -> anyhow::Result<Vec<u8>> {
    ensure!(pixels.len() == width * height, "{} pixels given for an image of {width} × {height}", pixels.len());
    let image = exr::prelude::Image::from_channels(
        (width, height),
        SpecificChannels::rgba(|at: exr::prelude::Vec2<usize>| {
            let [r, g, b, a] = pixels[at.x() + width * at.y()];
            (r, g, b, a)
        }),
    );
    let mut bytes = Vec::new();
    image.write().to_buffered(std::io::Cursor::new(&mut bytes)).context("cannot encode the image")?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use exr::prelude::f16;

    #[test]
    fn rgba_round_trip() {
        let pixels: Vec<[f32; 4]> = (0..12).map(|i| [i as f32, 1e-7, 3.5e8, -0.25]).collect();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("image.exr");
        std::fs::write(&path, encode_rgba(4, 3, &pixels).unwrap()).unwrap();
        let image = ExrImage::read(&path).unwrap();
        assert_eq!(image.size, [4, 3]);
        assert_eq!(image.rgb().unwrap()[5], [5.0, 1e-7, 3.5e8]);
        assert_eq!(image.alpha().unwrap(), [-0.25; 12]);
    }

    #[test]
    fn a_single_channel_is_alpha() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("alpha.exr");
        let channels = SpecificChannels::build()
            .with_channel::<f16>("Y")
            .with_pixel_fn(|at: exr::prelude::Vec2<usize>| (f16::from_f32(at.x() as f32 / 4.0),));
        exr::prelude::Image::from_channels((4, 1), channels).write().to_file(&path).unwrap();
        let image = ExrImage::read(&path).unwrap();
        assert_eq!(image.alpha().unwrap(), [0.0, 0.25, 0.5, 0.75]);
        assert!(image.rgb().unwrap_err().to_string().contains("among Y"));
    }

    #[test]
    fn not_an_image() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("text.exr");
        std::fs::write(&path, "not an image").unwrap();
        let error = format!("{:#}", ExrImage::read(&path).unwrap_err());
        assert!(error.contains("text.exr"), "{error}");
        assert!(encode_rgba(2, 2, &[[0.0; 4]; 3]).is_err());
    }
}
