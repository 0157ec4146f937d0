// An arm of a SCARA robot: a tapered bar with rounded ends and bearing bores, solid rings around the
// bores, of quadrilaterals or triangles; the lower half of the mesh is the mirror image of the upper
// one.
//
// The inboard joint axis lies at the origin, the arm points along +x, the outboard joint axis is
// at (length, 0). The interfaces are the bores' curves. The height is that at the inboard joint;
// the outboard end fits the inboard end of an arm whose height is `taper` times as large. Open this
// file in Gmsh and change the parameters on the left, or pass them with -setnumber.

SetFactory("Built-in");

DefineConstant[
  length  = {0.325, Min 0, Name "Parameters/1 length (m)"},
  height  = {0.1,   Min 0, Name "Parameters/2 height (m)"},
  size    = {height / 25, Min 0, Name "Parameters/3 mesh size (m)"},
  taper   = {0.75,  Min 0, Max 1, Name "Parameters/4 height at the outboard joint over that at the inboard one"},
  bores   = {0.4,   Min 0, Max 1, Name "Parameters/5 bore over the end's diameter"},
  passive = {height / 16, Min 0, Name "Parameters/6 width of the solid rings (m)"},
  quads   = {1, Choices{0 = "triangles", 1 = "quadrilaterals"}, Name "Parameters/7 cell shape"}
];

outer() = {height / 2, taper * height / 2};      // radii of the rounded ends
bore() = {bores * outer(0), bores * outer(1)};   // of the bores
ring() = {bore(0) + passive, bore(1) + passive}; // of the solid rings
If (bores <= 0 || passive <= 0 || ring(0) > 0.95 * outer(0) || ring(1) > 0.95 * outer(1))
  Error("bores of %g and %g m with solid rings of %g m do not fit into the ends", bore(0), bore(1), passive);
  Abort;
EndIf
If (outer(0) + outer(1) >= length)
  Error("the rounded ends of radii %g and %g m overlap within the length %g m", outer(0), outer(1), length);
  Abort;
EndIf

// Cells along the bar, half across it, on the outward quarter of a bore, through the ring and
// from there to the edge, which is farther away in the corners.
along = Ceil((length - outer(0) - outer(1)) / size - 0.01);
across = Ceil(outer(0) / size - 0.01);
quarter = Ceil(Pi / 2 * outer(0) / size - 0.01);
through = Ceil(passive / size - 0.01);
outwards = Ceil(1.2 * (outer(0) - ring(0)) / size - 0.01);

// Upper half. Around each joint four rays: outwards (1), towards the side (2), towards the corner
// (3) of the bar's end, and inwards (4); they meet bore (+0), ring (+4) and edge (+8). The sides
// are tangents of both ends, `lean` against the axis.
lean = Asin((outer(0) - outer(1)) / length);
d = Sqrt(0.5);
design() = {};
solid() = {};
For i In {0 : 1}
  p = 30 * (i + 1);
  x = i * length;
  s = 2 * i - 1; // the direction outwards
  R = outer(i);
  Point(p) = {x, 0, 0};
  For j In {0 : 4 : 4}
    radius = j ? ring(i) : bore(i);
    Point(p + j + 1) = {x + s * radius, 0, 0};
    Point(p + j + 2) = {x + radius * Sin(lean), radius * Cos(lean), 0};
    Point(p + j + 3) = {x - s * d * radius, d * radius, 0};
    Point(p + j + 4) = {x - s * radius, 0, 0};
    Circle(p + j + 1) = {p + j + 1, p, p + j + 2};
    Circle(p + j + 2) = {p + j + 2, p, p + j + 3};
    Circle(p + j + 3) = {p + j + 3, p, p + j + 4};
  EndFor
  inward = x + R * Sin(lean) - s * R * Cos(lean);
  Point(p + 9) = {x + s * R, 0, 0};
  Point(p + 10) = {x + R * Sin(lean), R * Cos(lean), 0};
  Point(p + 11) = {inward, R * Cos(lean) + s * R * Sin(lean), 0};
  Point(p + 12) = {inward, 0, 0};
  Circle(p + 9) = {p + 9, p, p + 10};
  Line(p + 10) = {p + 10, p + 11};
  Line(p + 11) = {p + 11, p + 12};
  For j In {1 : 4}
    Line(p + 14 + j) = {p + 4 + j, p + 8 + j};
    Line(p + 18 + j) = {p + j, p + 4 + j};
    Transfinite Curve {p + 14 + j} = outwards + 1;
    Transfinite Curve {p + 18 + j} = through + 1;
  EndFor
  For j In {1 : 3}
    Transfinite Curve {p + j, p + 4 + j, p + 8 + j} = (j == 1 ? quarter : across) + 1;
    Curve Loop(p + j) = {p + 14 + j, p + 8 + j, -(p + 15 + j), -(p + 4 + j)};
    Curve Loop(p + 4 + j) = {p + 18 + j, p + 4 + j, -(p + 19 + j), -(p + j)};
    Plane Surface(p + j) = {p + j};
    Plane Surface(p + 4 + j) = {p + 4 + j};
    design() += {p + j};
    solid() += {p + 4 + j};
  EndFor
EndFor
Line(1) = {41, 71};
Line(2) = {42, 72};
Transfinite Curve {1, 2} = along + 1;
Curve Loop(1) = {1, 71, -2, -41};
Plane Surface(1) = {1};
design() += {1};

// Its mirror image. Without `Periodic` the triangles would differ.
upper() = {design(), solid()};
lower() = Symmetry {0, 1, 0, 0} { Duplicata { Surface{upper()}; } };
Periodic Surface {lower()} = {upper()} Affine {1, 0, 0, 0,  0, -1, 0, 0,  0, 0, 1, 0,  0, 0, 0, 1};
MeshSize {:} = size;
If (quads)
  Transfinite Surface {upper()};
  Recombine Surface {upper(), lower()};
EndIf

// The interfaces are what bounds the arm within a box around a bore: its curves and no ray.
e = 1e-3 * bore(1);
bounds() = Abs(CombinedBoundary {Surface {upper(), lower()}; });
inboard() = {};
outboard() = {};
For k In {0 : #bounds() - 1}
  box() = BoundingBox Curve {bounds(k)};
  If (box(0) > -bore(0) - e && box(3) < bore(0) + e)
    inboard() += {bounds(k)};
  ElseIf (box(0) > length - bore(1) - e && box(3) < length + bore(1) + e)
    outboard() += {bounds(k)};
  EndIf
EndFor
Physical Curve("inboard", 1) = inboard();
Physical Curve("outboard", 2) = outboard();
Physical Surface("design", 3) = {design(), lower({0 : 6})};
Physical Surface("passive", 4) = {solid(), lower({7 : 12})};
