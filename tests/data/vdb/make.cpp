// Makes the .vdb files of this folder with OpenVDB itself, and expected.txt: what OpenVDB reads back from them.
//
//     apt-get install libopenvdb-dev libboost-iostreams-dev
//     g++ -O1 make.cpp -o /tmp/make -lopenvdb -ltbb -lImath-3_1 -lz && (cd tests/data/vdb && /tmp/make)
//
// A line of expected.txt: file, grid, box (cells a side), its least index, voxel size, world centre of the box, active voxels,
// leaves, background, saved as half (0/1), negative cells, CRC-32 of the box's values: little-endian f32, x fastest, negative
// values set to 0.

#include <openvdb/openvdb.h>
#include <openvdb/io/Stream.h>
#include <openvdb/tools/Dense.h>
#include <openvdb/tools/LevelSetSphere.h>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <zlib.h>

using namespace openvdb;

static std::FILE* expected;

// A smooth ball of density around `center`, its edge inactive.
template <typename GridT>
typename GridT::Ptr ball(const std::string& name, Coord center, int radius, double background = 0.0)
{
    auto grid = GridT::create(typename GridT::ValueType(background));
    grid->setName(name);
    auto acc = grid->getAccessor();
    for (int x = -radius; x <= radius; ++x)
        for (int y = -radius; y <= radius; ++y)
            for (int z = -radius; z <= radius; ++z) {
                double d = std::sqrt(double(x * x + y * y + z * z)) / radius;
                if (d < 1.0) acc.setValue(center.offsetBy(x, y, z), 1.7 * (1 - d) + 0.01 * std::sin(3.0 * x + y));
            }
    return grid;
}

static void write(const std::string& file, const GridPtrVec& grids, uint32_t compression = io::COMPRESS_BLOSC | io::COMPRESS_ACTIVE_MASK)
{
    io::File f(file);
    f.setCompression(compression);
    f.write(grids);
    f.close();
}

template <typename GridT>
void describe(const std::string& file, const GridT& grid)
{
    auto box = grid.evalActiveVoxelBoundingBox();
    tools::Dense<typename GridT::ValueType, tools::LayoutXYZ> dense(box);
    tools::copyToDense(grid, dense);
    std::vector<float> values(dense.valueCount());
    size_t negative = 0;
    for (size_t i = 0; i < values.size(); ++i) {
        values[i] = float(dense.data()[i]);
        if (values[i] < 0) {
            values[i] = 0;
            ++negative;
        }
    }
    auto crc = crc32(0, reinterpret_cast<const Bytef*>(values.data()), uInt(values.size() * 4));
    auto center = grid.transform().indexToWorld((box.min().asVec3d() + box.max().asVec3d()) * 0.5);
    std::fprintf(expected, "%s %s %d %d %d %d %d %d %.17g %.17g %.17g %.17g %llu %llu %.9g %d %zu %08lx\n", file.c_str(),
        grid.getName().c_str(), box.dim().x(), box.dim().y(), box.dim().z(), box.min().x(), box.min().y(), box.min().z(),
        grid.voxelSize().x(), center.x(), center.y(), center.z(), (unsigned long long)grid.activeVoxelCount(),
        (unsigned long long)grid.tree().leafCount(), double(grid.background()), int(grid.saveFloatAsHalf()), negative, crc);
}

// Reads the file back and notes what every scalar grid holds.
static void check(const std::string& file)
{
    io::File f(file);
    f.open(/*delayLoad=*/false);
    GridPtrVecPtr grids = f.getGrids();
    for (auto& base : *grids) {
        if (auto grid = gridPtrCast<FloatGrid>(base)) describe(file, *grid);
        if (auto grid = gridPtrCast<DoubleGrid>(base)) describe(file, *grid);
    }
}

static math::Transform::Ptr map(math::MapBase* m) { return math::Transform::Ptr(new math::Transform(math::MapBase::Ptr(m))); }

int main()
{
    initialize();
    expected = std::fopen("expected.txt", "w");
    const auto mask = io::COMPRESS_ACTIVE_MASK, zip = io::COMPRESS_ZIP, blosc = io::COMPRESS_BLOSC;

    { // Every value type and compression. Fog volumes are never zipped, other grids are.
        auto f = ball<FloatGrid>("density", Coord(20, 30, 40), 6);
        f->setTransform(map(new math::UniformScaleTranslateMap(0.25, Vec3d(1, -2, 3.5))));
        f->setGridClass(GRID_FOG_VOLUME);
        write("float_blosc.vdb", {f}, blosc | mask);
        f->setSaveFloatAsHalf(true);
        write("half_blosc.vdb", {f}, blosc | mask);
        write("half_mask.vdb", {f}, mask);
        f->setGridClass(GRID_UNKNOWN);
        write("half_zip.vdb", {f}, zip | mask);
        f->setSaveFloatAsHalf(false);
        write("float_zip.vdb", {f}, zip);
        auto d = ball<DoubleGrid>("density", Coord(-20, -30, -40), 6);
        d->setTransform(map(new math::UniformScaleMap(0.1)));
        write("double_zip.vdb", {d}, zip | mask);
        d->setSaveFloatAsHalf(true);
        write("double_half.vdb", {d}, blosc | mask);
        for (auto file : {"float_blosc.vdb", "half_blosc.vdb", "half_mask.vdb", "half_zip.vdb", "float_zip.vdb", "double_zip.vdb", "double_half.vdb"})
            check(file);
    }
    { // Active and inactive tiles at every level, and a background. The root's tile is inactive and reaches into the box.
        auto g = FloatGrid::create(0.3f);
        g->setName("density");
        auto& t = g->tree();
        t.addTile(1, Coord(4080, 0, 0), 1.5f, true);
        t.addTile(1, Coord(4088, 8, 0), 0.125f, false);
        t.addTile(2, Coord(3968, 0, 128), 0.7f, true);
        t.addTile(3, Coord(4096, 0, 0), 0.9f, false);
        t.setValue(Coord(4090, 5, 5), 2.0f);
        t.setValue(Coord(4100, -3, 5), 3.0f);
        t.setValueOff(Coord(4091, 5, 5), -1.0f);
        write("tiles.vdb", {g});
        check("tiles.vdb");
        g->setSaveFloatAsHalf(true);
        write("tiles_half.vdb", {g}, zip | mask);
        check("tiles_half.vdb");
    }
    { // One leaf for each of the seven ways to store inactive values.
        const float b = 0.3f;
        const std::vector<std::vector<float>> inactive = {{b}, {-b}, {0.5f}, {b, -b}, {b, 0.5f}, {0.6f, 0.5f}, {0.1f, 0.2f, 0.7f}};
        auto g = FloatGrid::create(b);
        g->setName("density");
        for (size_t leaf = 0; leaf < inactive.size(); ++leaf)
            for (int i = 0; i < 512; ++i) {
                Coord at(int(8 * leaf) + (i >> 6), i >> 3 & 7, i & 7);
                if (i % 3 == 0) g->tree().setValueOn(at, 0.01f * i);
                else g->tree().setValueOff(at, inactive[leaf][i % inactive[leaf].size()]);
            }
        write("inactive.vdb", {g});
        check("inactive.vdb");
        write("inactive_zip.vdb", {g}, zip);
        check("inactive_zip.vdb");
        g->setSaveFloatAsHalf(true);
        write("inactive_half.vdb", {g});
        check("inactive_half.vdb");
    }
    { // Several grids; "flame" is an instance of "heat" with a transform of its own.
        auto density = ball<FloatGrid>("density", Coord(8, 8, 8), 3), heat = ball<FloatGrid>("heat", Coord(4, 4, 4), 2);
        auto flame = heat->copy(); // shares the tree
        flame->setName("flame");
        flame->setTransform(map(new math::TranslationMap(Vec3d(1, 2, 3))));
        auto vel = Vec3SGrid::create();
        vel->setName("vel");
        vel->tree().setValue(Coord(1, 2, 3), Vec3s(1, 2, 3));
        write("several.vdb", {vel, heat, density, flame});
        check("several.vdb");
        write("two.vdb", {heat, flame->deepCopy()});
        auto again = density->deepCopy();
        again->insertMeta("note", StringMetadata("the second of its name"));
        write("same_name.vdb", {density, again});
        std::ofstream out("stream.vdb", std::ios::binary);
        io::Stream(out).write(GridCPtrVec{heat, density});
        out.close();
        check("stream.vdb");
    }
    { // Transforms.
        auto g = ball<FloatGrid>("density", Coord(5, 6, 7), 2);
        auto save = [&](const char* file, math::MapBase* m) {
            g->setTransform(map(m));
            write(file, {g});
        };
        save("scale_translate.vdb", new math::ScaleTranslateMap(Vec3d(0.5, 0.5, 0.5), Vec3d(0.1, 0.2, 0.3)));
        check("scale_translate.vdb");
        save("affine.vdb", new math::AffineMap(Mat4d(2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, -1, 3, 5, 1)));
        check("affine.vdb");
        save("stretched.vdb", new math::ScaleMap(Vec3d(1, 1, 2)));
        save("mirrored.vdb", new math::ScaleMap(Vec3d(-1, 1, 1)));
        save("rotated.vdb", new math::UnitaryMap(Vec3d(0, 1, 0), 0.5));
        save("frustum.vdb", new math::NonlinearFrustumMap(BBoxd(Vec3d(0), Vec3d(10)), 0.5, 10));
    }
    { // Grids that are no density.
        auto i = Int32Grid::create();
        i->setName("density");
        i->tree().setValue(Coord(1, 2, 3), 5);
        write("int.vdb", {i});
        auto sphere = tools::createLevelSetSphere<FloatGrid>(3, Vec3f(10, 10, 10), 1, 2);
        sphere->setName("surface");
        write("level_set.vdb", {sphere});
        auto empty = FloatGrid::create();
        empty->setName("density");
        write("empty.vdb", {empty});
        write("no_grids.vdb", {});
        auto nan = ball<FloatGrid>("density", Coord(5, 6, 7), 2);
        nan->tree().setValue(Coord(5, 7, 6), NAN);
        write("nan.vdb", {nan});
        auto huge = FloatGrid::create();
        huge->setName("density");
        huge->tree().setValue(Coord(0), 1);
        huge->tree().setValue(Coord(4000), 1);
        write("huge.vdb", {huge});
    }
    std::fclose(expected);
}
