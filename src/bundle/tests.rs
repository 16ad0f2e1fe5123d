//! Round trips, and what every kind of damage is called.

use std::sync::Arc;

use glam::{DVec3, UVec3};
use proptest::prelude::*;

use super::*;
use crate::rbf::Rbf;
use crate::residual::QuantizationLaw;

const SHAPE: GridShape = GridShape::new(UVec3::new(6, 5, 7));

/// A residual with every third cell occupied. One bucket and a table as long as the grid put every cell in the slot of
/// its flat index, so no search is needed.
fn residual() -> HashedResidual {
    let cells = SHAPE.len();
    let mut occupancy = vec![0u32; cells.div_ceil(32)];
    let mut values = Vec::new();
    for cell in (0..cells).step_by(3) {
        occupancy[cell / 32] |= 1 << (cell % 32);
        values.push(if cell % 2 == 0 { 1 + (cell % 127) as i8 } else { -5 });
    }
    let law = QuantizationLaw { max: 0.75, exponent: 1.5 };
    HashedResidual::from_parts(SHAPE, law, occupancy, &values, 1, vec![0], cells as u32).unwrap()
}

fn animation() -> SmokeAnimation {
    let rbfs = vec![
        Rbf { center: [0.1, -0.2, 0.3], radius: 0.25, weight: 1.5 },
        Rbf { center: [-0.3, 0.0, -0.45], radius: 0.1, weight: 0.01 },
    ];
    let smoke = SmokeFrame { rbfs: RbfModel { rbfs }, ids: vec![7, 3], residual: residual() };
    let clear = SmokeFrame::new(RbfModel::default(), HashedResidual::empty(SHAPE));
    SmokeAnimation {
        shape: SHAPE,
        placement: Placement { center: DVec3::new(1.0, -2.0, 1e-3), voxel_size: 0.05 },
        frames_per_second: 30.0,
        max_density: 2.25,
        frames: vec![smoke, clear].into(),
    }
}

fn frames(animation: &mut SmokeAnimation) -> &mut Vec<Arc<SmokeFrame>> {
    match &mut animation.frames {
        SmokeFrames::Memory(frames) => frames,
        SmokeFrames::Stream(_) => unreachable!("made in memory"),
    }
}

fn file() -> Vec<u8> {
    write(&animation()).unwrap()
}

const HEADER: usize = 96 + 2 * 32 + 4;

fn put(bytes: &mut [u8], at: usize, value: &[u8]) {
    bytes[at..at + value.len()].copy_from_slice(value);
}

/// Sets the header's checksum to what its bytes now need.
fn mend_header(bytes: &mut [u8]) {
    let crc = crc32fast::hash(&bytes[..HEADER - 4]);
    put(bytes, HEADER - 4, &crc.to_le_bytes());
}

/// The file with frame 0 replaced by `compressed`, which claims to hold `uncompressed` bytes, and right checksums.
fn with_frame(compressed: &[u8], uncompressed: u64) -> Vec<u8> {
    let mut bytes = file();
    let header = BundleHeader::read(&bytes).unwrap();
    bytes.splice(HEADER..header.frames[1].offset as usize, compressed.iter().copied());
    put(&mut bytes, 96 + 8, &(compressed.len() as u64).to_le_bytes());
    put(&mut bytes, 96 + 16, &uncompressed.to_le_bytes());
    put(&mut bytes, 96 + 24, &crc32fast::hash(compressed).to_le_bytes());
    put(&mut bytes, 96 + 32, &((HEADER + compressed.len()) as u64).to_le_bytes());
    mend_header(&mut bytes);
    bytes
}

/// The same with an uncompressed frame.
fn with_payload(payload: &[u8]) -> Vec<u8> {
    with_frame(&frame::compress(payload).unwrap(), payload.len() as u64)
}

fn payload() -> Vec<u8> {
    frame::encode(&frames(&mut animation())[0])
}

/// The message a file is refused with.
fn fault(bytes: &[u8]) -> String {
    read(bytes).expect_err("the file should be refused").to_string()
}

#[test]
fn round_trip() {
    assert_eq!(read(&file()).unwrap(), animation());
    let sizes = section_bytes(&frames(&mut animation())[0]);
    assert_eq!(sizes, SectionBytes { counts: 24, rbfs: 48, occupancy: 28, offsets: 2, residuals: 70 });
    assert_eq!(payload().len(), 172);
}

#[test]
fn single_frames_need_no_other_bytes() {
    let bytes = file();
    assert_eq!(BundleHeader::byte_length(&bytes[..BundleHeader::FIXED_BYTES]).unwrap(), HEADER);
    let header = BundleHeader::read(&bytes[..HEADER]).unwrap();
    assert_eq!(header.file_length(), bytes.len() as u64);
    for (index, entry) in header.frames.iter().enumerate() {
        let frame = &bytes[entry.offset as usize..(entry.offset + entry.length) as usize];
        assert_eq!(header.read_frame(index, frame).unwrap(), *frames(&mut animation())[index]);
    }
    let message = header.read_frame(2, &[]).unwrap_err().to_string();
    assert_eq!(message, "frame 2: there is no such frame, the bundle has 2");
}

#[test]
fn decoded_density_is_the_sum_and_never_negative() {
    let frame = frames(&mut animation())[0].clone();
    let cell = UVec3::new(3, 2, 5);
    let x = SHAPE.center(cell);
    let expected = (frame.rbfs.density(x) + frame.residual.get(cell)).max(0.0);
    // Both sides round a sum of three numbers of size 1.
    assert!((frame.decode()[SHAPE.index(cell)] - expected).abs() < 1e-6);
    assert!(frame.decode().iter().all(|&d| d >= 0.0));
}

#[test]
fn truncation_at_every_length() {
    let bytes = file();
    for length in 0..bytes.len() {
        let error = read(&bytes[..length]).unwrap_err();
        assert!(matches!(error, BundleError::Truncated { found, .. } if found == length as u64), "{length}: {error}");
    }
    let mut longer = bytes;
    longer.push(0);
    assert_eq!(fault(&longer), "1 bytes too many after the last frame");
}

#[test]
fn every_header_rule_has_its_message() {
    let nan = f32::NAN.to_le_bytes();
    let cases: &[(usize, &[u8], &str)] = &[
        (0, b"PNG", "not a .smoke file"),
        (8, &[1], "version 1 of the .smoke format; this library reads version 2"),
        (12, &[1], "header field flags"),
        (16, &[0], "header field header_length"),
        (20, &[0], "header field frame_count: 0"),
        (20, &[1, 0, 1], "header field frame_count: 65537"),
        (20, &[3], "header field header_length"),
        (24, &[0], "header field dims"),
        (24, &[1, 16], "a side has 1 to 4096"),
        (24, &[0, 16, 0, 0, 0, 16, 0, 0, 0, 16], "the limit is 268435456"),
        (36, &nan, "header field frames_per_second"),
        (36, &[0; 4], "header field frames_per_second"),
        (40, &f64::INFINITY.to_le_bytes(), "header field center"),
        (64, &0f64.to_le_bytes(), "header field voxel_size"),
        (72, &(-1f32).to_le_bytes(), "header field max_density"),
        (76, &[1], "header field reserved"),
        (95, &[1], "header field reserved"),
        (96, &[0], "frame 0: offset"),
        (96 + 8, &[0; 8], "frame 0: length"),
        (96 + 8, &[255; 8], "frame 0: length"),
        (96 + 8, &[1], "frame 1: offset"),
        (96 + 16, &[255; 8], "frame 0: uncompressed"),
        (96 + 16, &[1], "frame 0: its compressed data is not valid: it goes on after"),
        (96 + 16, &[255], "frame 0: its compressed data is not valid: it ends after 172 of 255"),
        (96 + 24, &[0; 4], "frame 0: its checksum"),
        (96 + 28, &[1], "frame 0: reserved"),
    ];
    for &(at, value, expected) in cases {
        let mut bytes = file();
        put(&mut bytes, at, value);
        mend_header(&mut bytes);
        assert!(fault(&bytes).contains(expected), "byte {at}: {}", fault(&bytes));
    }
    let mut bytes = file();
    bytes[40] ^= 1;
    assert_eq!(fault(&bytes), BundleError::HeaderChecksum.to_string());
}

#[test]
fn every_frame_rule_has_its_message() {
    let nan = f32::NAN.to_le_bytes();
    let cases: &[(usize, &[u8], &str)] = &[
        (0, &[3], "it has 172 bytes where its counts need 196"),
        (0, &[1, 0, 1], "rbf_count: 65537"),
        (4, &nan, "quantisation law"),
        (4, &2e30f32.to_le_bytes(), "law_max"),
        (8, &0f32.to_le_bytes(), "quantisation law"),
        (12, &[71], "where its counts need 173"),
        (16, &[0], "where its counts need 170"),
        (16, &[33], "offset_side: 33"),
        (16, &[255; 4], "offset_side"),
        (20, &[69, 0], "hash table of 69 slots"),
        (20, &[255, 0], "hash table of 255 slots"),
        (20, &[72, 0], "meets another"),
        (24, &nan, "rbfs: number 0 has its centre"),
        (44, &f32::INFINITY.to_le_bytes(), "rbfs: number 1 has its centre"),
        (36, &0f32.to_le_bytes(), "rbfs: number 0 has radius"),
        (36, &5f32.to_le_bytes(), "rbfs: number 0 has radius"),
        (40, &0f32.to_le_bytes(), "rbfs: number 0 has weight"),
        (40, &f32::INFINITY.to_le_bytes(), "rbfs: number 0 has weight"),
        (64, &[3], "ids: two RBFs have the number 3"),
        (72, &[0], "list of values has 70 entries"),
        (99, &[255], "after the grid's last cell"),
        (102, &[0], "value 0"),
        (102, &[128], "value -128"),
    ];
    for &(at, value, expected) in cases {
        let mut payload = payload();
        put(&mut payload, at, value);
        let message = fault(&with_payload(&payload));
        assert!(message.starts_with("frame 0: ") && message.contains(expected), "byte {at}: {message}");
    }
    assert!(fault(&with_payload(&[])).contains("it has 0 bytes where its counts need 24"));
}

#[test]
fn frames_that_decompress_to_too_much_are_refused() {
    // Honest data, but 64 MiB where the table claims 164 bytes.
    let zeros = frame::compress(&vec![0; 64 << 20]).unwrap();
    assert!(fault(&with_frame(&zeros, 164)).contains("not valid"));

    // A window of 1 GiB: magic, no content size, window exponent 20, one empty last block.
    let window = [0x28, 0xB5, 0x2F, 0xFD, 0x00, 20 << 3, 1, 0, 0];
    assert!(fault(&with_frame(&window, 0)).contains("not valid"));

    // One block of 2000 matches of 131,074 bytes each: 250 MiB from 4 KiB, where a block may hold 128 KiB.
    const MATCHES: usize = 2000;
    let mut bomb = vec![0x28, 0xB5, 0x2F, 0xFD, 0x00, 10 << 3];
    bomb.extend([8 << 3, 0, 0]);
    bomb.extend([0; 8]);
    let mut block = vec![0, 128 + (MATCHES >> 8) as u8, MATCHES as u8, 0x54, 0, 0, 52];
    block.extend([255; 2 * MATCHES]);
    block.push(1);
    let block_header = (block.len() as u32) << 3 | 2 << 1 | 1;
    bomb.extend(&block_header.to_le_bytes()[..3]);
    bomb.extend(block);
    let message = fault(&with_frame(&bomb, 164));
    assert!(message.contains("not valid") && message.to_lowercase().contains("bytes"), "{message}");

    // Two Zstandard frames, or junk after the first.
    let mut twice = frame::compress(&payload()).unwrap();
    twice.extend_from_slice(&twice.clone());
    assert!(fault(&with_frame(&twice, payload().len() as u64)).contains("bytes follow it"));
}

#[test]
fn writing_refuses_what_reading_would() {
    let refused = |change: fn(&mut SmokeAnimation)| {
        let mut animation = animation();
        change(&mut animation);
        write(&animation).unwrap_err().to_string()
    };
    assert!(refused(|a| frames(a).clear()).contains("frame_count"));
    assert!(refused(|a| a.frames_per_second = 0.0).contains("frames_per_second"));
    assert!(refused(|a| a.shape = GridShape::new(UVec3::new(5, 6, 7))).contains("its box"));
    assert!(refused(|a| Arc::make_mut(&mut frames(a)[0]).rbfs.rbfs[1].radius = f32::NAN).contains("radius"));
}

/// A file that is accepted is usable: it can be written again and its density is a number everywhere.
fn check_usable(bytes: &[u8]) {
    if let Ok(mut animation) = read(bytes) {
        assert_eq!(read(&write(&animation).unwrap()).unwrap(), animation);
        for frame in frames(&mut animation) {
            assert!(frame.decode().iter().all(|d| d.is_finite() && *d >= 0.0));
        }
    }
}

/// Up to four bytes to change, anywhere in `0..length`.
fn changes(length: usize) -> impl Strategy<Value = Vec<(usize, u8)>> {
    prop::collection::vec((0..length, any::<u8>()), 1..=4)
}

fn apply(bytes: &mut [u8], changes: &[(usize, u8)]) -> bool {
    let before = bytes.to_vec();
    for &(at, value) in changes {
        bytes[at] = value;
    }
    bytes != before
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    /// Up to four changed bytes never pass: CRC-32 catches all bursts up to four bytes, and others but for one in 2³².
    #[test]
    fn damage_is_noticed(changes in changes(file().len())) {
        let mut bytes = file();
        if apply(&mut bytes, &changes) {
            prop_assert!(read(&bytes).is_err());
        }
    }

    /// The same in the header, its checksum made right: what the checks behind the checksum are for.
    #[test]
    fn forged_headers(changes in changes(HEADER)) {
        let mut bytes = file();
        apply(&mut bytes, &changes);
        mend_header(&mut bytes);
        check_usable(&bytes);
    }

    /// The same in a frame's compressed bytes.
    #[test]
    fn forged_compression(changes in changes(frame::compress(&payload()).unwrap().len())) {
        let mut compressed = frame::compress(&payload()).unwrap();
        apply(&mut compressed, &changes);
        check_usable(&with_frame(&compressed, payload().len() as u64));
    }

    /// The same in a frame's content.
    #[test]
    fn forged_content(changes in changes(payload().len())) {
        let mut payload = payload();
        apply(&mut payload, &changes);
        check_usable(&with_payload(&payload));
    }

    /// Bytes that are nothing at all, and such behind a valid start.
    #[test]
    fn noise(keep in 0..=HEADER, noise in prop::collection::vec(any::<u8>(), 0..400)) {
        let mut bytes = file()[..keep].to_vec();
        bytes.extend(&noise);
        check_usable(&bytes);
        check_usable(&with_frame(&noise, 164));
        check_usable(&with_payload(&noise));
    }
}
