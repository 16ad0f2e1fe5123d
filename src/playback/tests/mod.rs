//! Playback without a renderer: an app that streams from an archive in memory, which can be slow, damaged and changed.

mod moment;
mod streaming;
mod timeline;

use std::io::SeekFrom;
use std::path::Path;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, RwLock};
use std::task::{Context, Poll};
use std::time::Duration;

use bevy::asset::io::{
    AssetReader, AssetReaderError, AssetSourceBuilder, AssetSourceId, PathStream, Reader, ReaderNotSeekableError,
    SeekableReader, VecReader,
};
use bevy::prelude::*;
use bevy::tasks::futures_lite::future::yield_now;
use bevy::tasks::futures_lite::{AsyncRead, AsyncSeek};
use bevy::time::TimeUpdateStrategy;
use glam::DVec3;

use super::*;
use crate::bundle::{self, SmokeAnimation, SmokeAnimationLoader, SmokeFrame};
use crate::density::{GridShape, Placement};
use crate::rbf::{Rbf, RbfModel};
use crate::residual::HashedResidual;

/// An asset source with one file, under every path.
#[derive(Clone, Default)]
struct Archive(Arc<Content>);

#[derive(Default)]
struct Content {
    file: RwLock<Vec<u8>>,
    /// Whether reads wait.
    shut: AtomicBool,
    /// Whether files can only be read from their start.
    sequential: AtomicBool,
    bytes_read: AtomicUsize,
}

impl Archive {
    fn put(&self, file: Vec<u8>) {
        *self.0.file.write().unwrap() = file;
    }

    fn shut(&self, shut: bool) {
        self.0.shut.store(shut, Ordering::Relaxed);
    }
}

struct File {
    content: VecReader,
    archive: Archive,
}

impl AsyncRead for File {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut [u8]) -> Poll<std::io::Result<usize>> {
        let read = Pin::new(&mut self.content).poll_read(cx, buffer);
        if let Poll::Ready(Ok(bytes)) = read {
            self.archive.0.bytes_read.fetch_add(bytes, Ordering::Relaxed);
        }
        read
    }
}

impl AsyncSeek for File {
    fn poll_seek(mut self: Pin<&mut Self>, cx: &mut Context<'_>, to: SeekFrom) -> Poll<std::io::Result<u64>> {
        Pin::new(&mut self.content).poll_seek(cx, to)
    }
}

impl Reader for File {
    fn seekable(&mut self) -> Result<&mut dyn SeekableReader, ReaderNotSeekableError> {
        if self.archive.0.sequential.load(Ordering::Relaxed) { Err(ReaderNotSeekableError) } else { Ok(self) }
    }
}

impl AssetReader for Archive {
    async fn read<'a>(&'a self, _path: &'a Path) -> Result<impl Reader + 'a, AssetReaderError> {
        while self.0.shut.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(1));
            yield_now().await;
        }
        let content = VecReader::new(self.0.file.read().unwrap().clone());
        Ok(File { content, archive: self.clone() })
    }

    async fn read_meta<'a>(&'a self, path: &'a Path) -> Result<impl Reader + 'a, AssetReaderError> {
        Err::<VecReader, _>(AssetReaderError::NotFound(path.into()))
    }

    async fn read_directory<'a>(&'a self, path: &'a Path) -> Result<Box<PathStream>, AssetReaderError> {
        Err(AssetReaderError::NotFound(path.into()))
    }

    async fn is_directory<'a>(&'a self, _path: &'a Path) -> Result<bool, AssetReaderError> {
        Ok(false)
    }
}

const FPS: f32 = 30.0;

/// Frames that can be told apart: each has one RBF, of weight 1 more than the frame's number and `more`.
fn animation(frames: usize, more: f32) -> SmokeAnimation {
    let shape = GridShape::new(UVec3::new(4, 4, 4));
    let frame = |index: usize| {
        let rbf = Rbf { center: [0.0; 3], radius: 0.2, weight: 1.0 + index as f32 + more };
        SmokeFrame::new(RbfModel { rbfs: vec![rbf] }, HashedResidual::empty(shape))
    };
    SmokeAnimation {
        shape,
        placement: Placement { center: DVec3::ZERO, voxel_size: 0.25 },
        frames_per_second: FPS,
        max_density: 100.0,
        frames: (0..frames).map(frame).collect::<Vec<_>>().into(),
    }
}

fn file(frames: usize, more: f32) -> Vec<u8> {
    bundle::write(&animation(frames, more)).unwrap()
}

/// The events of a volume so far.
#[derive(Resource, Clone, Copy, Debug, Default, PartialEq)]
struct Heard {
    ready: u32,
    looped: u32,
    finished: u32,
}

/// How often a volume's moment has changed.
#[derive(Resource, Default)]
struct Changes(usize);

struct Theatre {
    app: App,
    archive: Archive,
}

impl Theatre {
    /// An app whose clock stands still, with `file` in its archive.
    fn new(file: Vec<u8>) -> Self {
        let archive = Archive::default();
        archive.put(file);
        let mut app = App::new();
        let source = archive.clone();
        app.add_plugins(MinimalPlugins)
            .register_asset_source(AssetSourceId::Default, AssetSourceBuilder::new(move || Box::new(source.clone())))
            .add_plugins(AssetPlugin::default())
            .init_asset::<SmokeAnimation>()
            .init_asset_loader::<SmokeAnimationLoader>()
            .add_plugins(SmokePlaybackPlugin)
            .init_resource::<Heard>()
            .init_resource::<Changes>()
            .insert_resource(TimeUpdateStrategy::ManualDuration(Duration::ZERO))
            .add_observer(|_: On<SmokeReady>, mut heard: ResMut<Heard>| heard.ready += 1)
            .add_observer(|looped: On<SmokeLooped>, mut heard: ResMut<Heard>| heard.looped += looped.times)
            .add_observer(|_: On<SmokeFinished>, mut heard: ResMut<Heard>| heard.finished += 1)
            .add_systems(Last, |changed: Query<(), Changed<SmokeMoment>>, mut changes: ResMut<Changes>| {
                changes.0 += changed.iter().count();
            });
        app.finish();
        app.cleanup();
        Self { app, archive }
    }

    fn load(&self) -> Handle<SmokeAnimation> {
        self.app.world().resource::<AssetServer>().load("smoke.smoke")
    }

    /// A volume of the archive's file.
    fn play(&mut self, playback: SmokePlayback) -> Entity {
        let animation = self.load();
        self.app.world_mut().spawn((SmokeVolume::new(animation), playback)).id()
    }

    /// Runs until `done`, with the clock standing still.
    fn wait_until(&mut self, what: &str, mut done: impl FnMut(&World) -> bool) {
        self.app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::ZERO));
        for _ in 0..5000 {
            self.app.update();
            if done(self.app.world()) {
                return;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        panic!("waited in vain until {what}");
    }

    /// Waits until all frames that are wanted are there.
    fn wait(&mut self) {
        self.wait_until("all is read", |world| {
            let loaded = |animation| world.resource::<AssetServer>().load_state(animation);
            let mut handles = world.iter_entities().filter_map(|entity| entity.get::<SmokeVolume>());
            handles.all(|volume| {
                !loaded(volume.animation().unwrap().id()).is_loading()
                    || world.resource::<Assets<SmokeAnimation>>().contains(volume.animation().unwrap())
            }) && world.resource::<SmokeStreamingStats>().tasks == 0
        });
        // What came last has been shown.
        self.app.update();
    }

    /// One update of so many frames' time, with nothing in the way, and nothing after.
    fn step(&mut self, frames: f64) {
        self.app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_secs_f64(frames / f64::from(FPS))));
        self.app.update();
    }

    /// What a volume shows, in frames, if anything.
    fn shown(&self, volume: Entity) -> Option<f32> {
        let moment = self.app.world().get::<SmokeMoment>(volume).unwrap().0.as_ref()?;
        Some(moment.rbfs().rbfs[0].weight - 1.0)
    }

    fn playback(&mut self, volume: Entity) -> Mut<'_, SmokePlayback> {
        self.app.world_mut().get_mut(volume).unwrap()
    }

    fn stats(&self) -> &SmokeStreamingStats {
        self.app.world().resource()
    }

    fn heard(&self) -> Heard {
        *self.app.world().resource()
    }
}
