//! A place in the file's bytes; reading moves it on and never past the end.

use super::DensityError;

pub(super) struct Cursor<'a> {
    bytes: &'a [u8],
    position: usize,
}

impl<'a> Cursor<'a> {
    /// A cursor at the start of the file.
    pub fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, position: 0 }
    }

    /// Goes to an offset from the start of the file.
    pub fn seek(&mut self, position: usize) -> Result<(), DensityError> {
        if position > self.bytes.len() {
            return Err(DensityError::Truncated("a grid"));
        }
        self.position = position;
        Ok(())
    }

    pub fn position(&self) -> usize {
        self.position
    }

    /// The next `length` bytes. `what` they belong to goes into the error.
    pub fn take(&mut self, length: usize, what: &'static str) -> Result<&'a [u8], DensityError> {
        let taken = self.bytes[self.position..].get(..length).ok_or(DensityError::Truncated(what))?;
        self.position += length;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], DensityError> {
        let &array = self.bytes[self.position..].first_chunk().ok_or(DensityError::Truncated(what))?;
        self.position += N;
        Ok(array)
    }

    pub fn u8(&mut self, what: &'static str) -> Result<u8, DensityError> {
        self.array(what).map(u8::from_le_bytes)
    }

    pub fn u32(&mut self, what: &'static str) -> Result<u32, DensityError> {
        self.array(what).map(u32::from_le_bytes)
    }

    pub fn i32(&mut self, what: &'static str) -> Result<i32, DensityError> {
        self.array(what).map(i32::from_le_bytes)
    }

    pub fn i64(&mut self, what: &'static str) -> Result<i64, DensityError> {
        self.array(what).map(i64::from_le_bytes)
    }

    pub fn f32(&mut self, what: &'static str) -> Result<f32, DensityError> {
        self.array(what).map(f32::from_le_bytes)
    }

    pub fn f64(&mut self, what: &'static str) -> Result<f64, DensityError> {
        self.array(what).map(f64::from_le_bytes)
    }

    /// A length and that many bytes of text.
    pub fn string(&mut self, what: &'static str) -> Result<String, DensityError> {
        let length = self.u32(what)? as usize;
        Ok(String::from_utf8_lossy(self.take(length, what)?).into_owned())
    }
}
